//! Assigns users to UAVs so that the sum of AoI is low when each UAV flies its tour alone.
//!
//! Up to [`MAX_EXHAUSTIVE`] users and UAVs, all assignments are compared. Larger problems start from clusters of users, and users
//! are moved between UAVs that are near, within a bounded number of simulated flights.

use super::order::shorten;
use super::pilot::{Pilot, Problem};
use crate::policy::flight::distance;

/// Maximum number of users, and of UAVs, for which all assignments are compared.
const MAX_EXHAUSTIVE: usize = 8;
/// Rounds of k-means.
const ROUNDS: usize = 10;
/// Bound on the work of improving clusters, in the unit of [`work`].
const WORK: usize = 20_000_000;
/// Number of UAVs to which moving a user is tried.
const NEIGHBOURS: usize = 3;

/// A tour per UAV; together they visit every user once.
pub fn tours(problem: &Problem) -> Vec<Vec<u32>> {
    if problem.users.len() <= MAX_EXHAUSTIVE && problem.uavs.len() <= MAX_EXHAUSTIVE { exact(problem) } else { clusters(problem) }
}

/// A tour and the sum of the AoI of its users over the slots.
#[derive(Clone, Debug, Default)]
struct ScoredTour {
    tour: Vec<u32>,
    age: f64,
}

/// The best tour of UAV `uav` through `users`: a short cyclic tour, started at each of the nearest users, in both directions.
fn best_tour(problem: &Problem, uav: usize, mut users: Vec<u32>) -> ScoredTour {
    /// Number of users with which starting the tour is tried.
    const FIRST_USERS: usize = 2;
    users.sort_unstable();
    shorten(&mut users, problem.users);
    let n = users.len();
    if n < 2 {
        return ScoredTour { age: age(problem, uav, &users), tour: users };
    }
    let from = |&i: &usize| distance(problem.uavs[uav], problem.users[users[i] as usize]);
    let mut first: Vec<usize> = (0..n).collect();
    first.sort_by(|a, b| from(a).total_cmp(&from(b)).then(a.cmp(b)));
    let mut best = ScoredTour { tour: Vec::new(), age: f64::INFINITY };
    for &i in &first[..n.min(FIRST_USERS)] {
        let forward: Vec<u32> = (0..n).map(|k| users[(i + k) % n]).collect();
        let backward: Vec<u32> = (0..n).map(|k| users[(i + n - k) % n]).collect();
        let tours = if n > 2 { vec![forward, backward] } else { vec![forward] };
        for tour in tours {
            let age = age(problem, uav, &tour);
            if age < best.age {
                best = ScoredTour { tour, age };
            }
        }
    }
    best
}

/// Sum over slots of the AoI of the users of a tour that one UAV flies.
fn age(problem: &Problem, uav: usize, tour: &[u32]) -> f64 {
    let pilot = Pilot::new(problem.env);
    let mut ages: Vec<f64> = tour.iter().map(|&user| problem.aoi[user as usize].into()).collect();
    let mut sum = 0.0;
    for at in pilot.path(problem, uav, tour.to_vec()) {
        for (age, &user) in ages.iter_mut().zip(tour) {
            *age = if pilot.collects(at, problem.users[user as usize]) { 0.0 } else { *age + 1.0 };
            sum += *age;
        }
    }
    sum
}

/// Estimated duration of [`best_tour`], in nanoseconds.
fn work(problem: &Problem, users: usize) -> usize {
    problem.slots * 6 * (64 + users) + 100 * users * users.min(64)
}

/// The best of all assignments, by dynamic programming: for each UAV in turn and each set of users that the UAVs so far serve,
/// the best set for this UAV.
fn exact(problem: &Problem) -> Vec<Vec<u32>> {
    let (m, n) = (problem.uavs.len(), problem.users.len());
    let sets = 1 << n;
    // No UAV is without users while another has two.
    let max_users = (n + 1).saturating_sub(m).max(1);
    let members = |set: usize| (0..n as u32).filter(|user| set >> user & 1 == 1).collect::<Vec<_>>();
    let mut flown: Vec<Vec<Option<ScoredTour>>> = Vec::with_capacity(m);
    for uav in 0..m {
        let twin = (0..uav).find(|&other| problem.uavs[other] == problem.uavs[uav]);
        flown.push(match twin {
            Some(other) => flown[other].clone(),
            None => (0..sets)
                .map(|set: usize| (set.count_ones() as usize <= max_users).then(|| best_tour(problem, uav, members(set))))
                .collect(),
        });
    }
    // best[set]: sum of AoI and the sets of the UAVs so far, which together serve `set`.
    let mut best: Vec<Option<(f64, Vec<usize>)>> = vec![None; sets];
    best[0] = Some((0.0, Vec::new()));
    for tours in &flown {
        let mut next: Vec<Option<(f64, Vec<usize>)>> = vec![None; sets];
        for (set, next) in next.iter_mut().enumerate() {
            // All subsets of `set`, the empty one last.
            let mut own = set;
            loop {
                if let (Some(flown), Some((before, sets))) = (&tours[own], &best[set & !own])
                    && next.as_ref().is_none_or(|(age, _)| before + flown.age < *age)
                {
                    *next = Some((before + flown.age, [&sets[..], &[own]].concat()));
                }
                if own == 0 {
                    break;
                }
                own = (own - 1) & set;
            }
        }
        best = next;
    }
    let own = best[sets - 1].take().map_or_else(Vec::new, |(_, own)| own);
    let tour = |(tours, own): (&Vec<Option<ScoredTour>>, usize)| tours[own].clone().unwrap_or_default().tour;
    flown.iter().zip(own).map(tour).collect()
}

/// k-means from centres that are far apart; then users move between UAVs while that lowers the sum of AoI.
fn clusters(problem: &Problem) -> Vec<Vec<u32>> {
    let groups = k_means(problem);
    let mut left = WORK;
    let mut fly = |uav: usize, users: Vec<u32>| {
        let cost = work(problem, users.len());
        left = left.checked_sub(cost)?;
        Some(best_tour(problem, uav, users))
    };
    let mut flown = Vec::with_capacity(groups.len());
    for (uav, users) in groups.iter().enumerate() {
        let Some(tour) = fly(uav, users.clone()) else { break };
        flown.push(tour);
    }
    if flown.len() < groups.len() {
        // Too large to simulate: use short tours.
        return groups
            .into_iter()
            .map(|mut users| {
                shorten(&mut users, problem.users);
                users
            })
            .collect();
    }
    let mut better = true;
    while std::mem::take(&mut better) {
        for user in 0..problem.users.len() as u32 {
            let Some(from) = flown.iter().position(|f| f.tour.contains(&user)) else { continue };
            for to in neighbours(problem, &flown, user, from) {
                let without = flown[from].tour.iter().copied().filter(|&u| u != user).collect();
                let with = flown[to].tour.iter().copied().chain([user]).collect();
                let (Some(a), Some(b)) = (fly(from, without), fly(to, with)) else {
                    return flown.into_iter().map(|f| f.tour).collect();
                };
                if a.age + b.age < flown[from].age + flown[to].age - 1e-9 {
                    flown[from] = a;
                    flown[to] = b;
                    better = true;
                    break;
                }
            }
        }
    }
    flown.into_iter().map(|f| f.tour).collect()
}

/// The UAVs other than `from` with a user near `user`, nearest first. UAVs without users come first.
fn neighbours(problem: &Problem, flown: &[ScoredTour], user: u32, from: usize) -> Vec<usize> {
    let at = problem.users[user as usize];
    let near = |f: &ScoredTour| f.tour.iter().map(|&u| distance(at, problem.users[u as usize])).fold(f64::INFINITY, f64::min);
    let mut others: Vec<(f64, usize)> = flown
        .iter()
        .enumerate()
        .filter(|&(uav, _)| uav != from)
        .map(|(uav, f)| (if f.tour.is_empty() { 0.0 } else { near(f) }, uav))
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.iter().take(NEIGHBOURS).map(|&(_, uav)| uav).collect()
}

/// Assigns users to the nearest of at most M centres, and each cluster to the nearest UAV without a cluster.
fn k_means(problem: &Problem) -> Vec<Vec<u32>> {
    let users = problem.users;
    let mut centers = vec![users[0]];
    let mut apart: Vec<f64> = users.iter().map(|&u| distance(u, users[0])).collect();
    while centers.len() < problem.uavs.len().min(users.len()) {
        let farthest = (0..users.len()).max_by(|&a, &b| apart[a].total_cmp(&apart[b]).then(b.cmp(&a))).unwrap_or(0);
        centers.push(users[farthest]);
        apart.iter_mut().zip(users).for_each(|(d, &u)| *d = d.min(distance(u, users[farthest])));
    }
    let mut groups = Vec::new();
    for _ in 0..ROUNDS {
        groups = vec![Vec::new(); centers.len()];
        for (user, &at) in users.iter().enumerate() {
            let nearest = (0..centers.len()).min_by(|&a, &b| distance(at, centers[a]).total_cmp(&distance(at, centers[b])));
            groups[nearest.unwrap_or(0)].push(user as u32);
        }
        for (center, group) in centers.iter_mut().zip(&groups).filter(|(_, group)| !group.is_empty()) {
            *center = [0, 1].map(|k| group.iter().map(|&u| users[u as usize][k]).sum::<f64>() / group.len() as f64);
        }
    }
    let mut own = vec![Vec::new(); problem.uavs.len()];
    let mut free: Vec<usize> = (0..problem.uavs.len()).collect();
    for (center, group) in centers.iter().zip(groups) {
        let to = |i: &usize| distance(problem.uavs[free[*i]], *center);
        let nearest = (0..free.len()).min_by(|a, b| to(a).total_cmp(&to(b))).unwrap_or(0);
        own[free.remove(nearest)] = group;
    }
    own
}
