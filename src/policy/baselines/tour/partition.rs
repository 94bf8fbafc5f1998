//! Who serves whom: users are shared out so that the UAVs' tours, each flown alone, keep the sum of ages low.
//!
//! Exact over all ways to share up to [`EXACT`] users among as many UAVs; above, clusters improved by moving users between
//! neighbouring UAVs, within a bounded number of simulated flights.

use super::super::geometry::distance;
use super::flight::{Pilot, Scene};
use super::order::shorten;

/// Most users, and UAVs, for which every way to share is looked at.
const EXACT: usize = 8;
/// Rounds of k-means.
const ROUNDS: usize = 10;
/// Simulation that improving clusters may take, in about nanoseconds.
const WORK: usize = 20_000_000;
/// Neighbouring UAVs that a user may be moved to.
const NEIGHBOURS: usize = 3;

/// A tour per UAV; together they visit every user once.
pub fn tours(scene: &Scene) -> Vec<Vec<u32>> {
    if scene.users.len() <= EXACT && scene.uavs.len() <= EXACT { exact(scene) } else { clusters(scene) }
}

/// A tour and the sum of ages of its users over the slots.
#[derive(Clone, Debug, Default)]
struct Flown {
    tour: Vec<u32>,
    age: f64,
}

/// The best tour of UAV `uav` through these users: a short one, begun at the nearest users, either way round.
fn best_tour(scene: &Scene, uav: usize, mut users: Vec<u32>) -> Flown {
    /// Users that a tour may begin with.
    const BEGINNINGS: usize = 2;
    users.sort_unstable();
    shorten(&mut users, scene.users);
    let n = users.len();
    if n < 2 {
        return Flown { age: age(scene, uav, &users), tour: users };
    }
    let from = |&i: &usize| distance(scene.uavs[uav], scene.users[users[i] as usize]);
    let mut first: Vec<usize> = (0..n).collect();
    first.sort_by(|a, b| from(a).total_cmp(&from(b)).then(a.cmp(b)));
    let mut best = Flown { tour: Vec::new(), age: f64::INFINITY };
    for &i in &first[..n.min(BEGINNINGS)] {
        let there: Vec<u32> = (0..n).map(|k| users[(i + k) % n]).collect();
        let back: Vec<u32> = (0..n).map(|k| users[(i + n - k) % n]).collect();
        let ways = if n > 2 { vec![there, back] } else { vec![there] };
        for tour in ways {
            let age = age(scene, uav, &tour);
            if age < best.age {
                best = Flown { tour, age };
            }
        }
    }
    best
}

/// Sum over slots of the ages of the users of a tour that one UAV flies.
fn age(scene: &Scene, uav: usize, tour: &[u32]) -> f64 {
    let pilot = Pilot::new(scene.world);
    let mut ages: Vec<f64> = tour.iter().map(|&user| scene.aoi[user as usize].into()).collect();
    let mut sum = 0.0;
    for at in pilot.path(scene, uav, tour.to_vec()) {
        for (age, &user) in ages.iter_mut().zip(tour) {
            *age = if pilot.collects(at, scene.users[user as usize]) { 0.0 } else { *age + 1.0 };
            sum += *age;
        }
    }
    sum
}

/// About how long [`best_tour`] takes, in nanoseconds.
fn work(scene: &Scene, users: usize) -> usize {
    scene.slots * 6 * (64 + users) + 100 * users * users.min(64)
}

/// The best of all ways to share: for each UAV in turn and each set of users served so far, the best set of its own.
fn exact(scene: &Scene) -> Vec<Vec<u32>> {
    let (m, n) = (scene.uavs.len(), scene.users.len());
    let sets = 1 << n;
    // No UAV stays idle while another has two users.
    let most = (n + 1).saturating_sub(m).max(1);
    let members = |set: usize| (0..n as u32).filter(|user| set >> user & 1 == 1).collect::<Vec<_>>();
    let mut flown: Vec<Vec<Option<Flown>>> = Vec::with_capacity(m);
    for uav in 0..m {
        let twin = (0..uav).find(|&other| scene.uavs[other] == scene.uavs[uav]);
        flown.push(match twin {
            Some(other) => flown[other].clone(),
            None => (0..sets)
                .map(|set: usize| (set.count_ones() as usize <= most).then(|| best_tour(scene, uav, members(set))))
                .collect(),
        });
    }
    // best[set]: ages and own sets of the UAVs so far, which serve `set` together.
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
    let tour = |(tours, own): (&Vec<Option<Flown>>, usize)| tours[own].clone().unwrap_or_default().tour;
    flown.iter().zip(own).map(tour).collect()
}

/// k-means from centres that are far apart, then users moved between neighbours while that helps.
fn clusters(scene: &Scene) -> Vec<Vec<u32>> {
    let groups = k_means(scene);
    let mut left = WORK;
    let mut fly = |uav: usize, users: Vec<u32>| {
        let cost = work(scene, users.len());
        left = left.checked_sub(cost)?;
        Some(best_tour(scene, uav, users))
    };
    let mut flown = Vec::with_capacity(groups.len());
    for (uav, users) in groups.iter().enumerate() {
        let Some(tour) = fly(uav, users.clone()) else { break };
        flown.push(tour);
    }
    if flown.len() < groups.len() {
        // Too many to simulate: short tours are all that is asked for.
        return groups
            .into_iter()
            .map(|mut users| {
                shorten(&mut users, scene.users);
                users
            })
            .collect();
    }
    let mut better = true;
    while std::mem::take(&mut better) {
        for user in 0..scene.users.len() as u32 {
            let Some(from) = flown.iter().position(|f| f.tour.contains(&user)) else { continue };
            for to in neighbours(scene, &flown, user, from) {
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

/// The UAVs other than `from` that serve somebody near `user`, nearest first; those that serve nobody count as near.
fn neighbours(scene: &Scene, flown: &[Flown], user: u32, from: usize) -> Vec<usize> {
    let at = scene.users[user as usize];
    let near = |f: &Flown| f.tour.iter().map(|&u| distance(at, scene.users[u as usize])).fold(f64::INFINITY, f64::min);
    let mut others: Vec<(f64, usize)> = flown
        .iter()
        .enumerate()
        .filter(|&(uav, _)| uav != from)
        .map(|(uav, f)| (if f.tour.is_empty() { 0.0 } else { near(f) }, uav))
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.iter().take(NEIGHBOURS).map(|&(_, uav)| uav).collect()
}

/// Users by the nearest of at most M centres; each UAV takes the cluster that is nearest to it and still free.
fn k_means(scene: &Scene) -> Vec<Vec<u32>> {
    let users = scene.users;
    let mut centers = vec![users[0]];
    let mut apart: Vec<f64> = users.iter().map(|&u| distance(u, users[0])).collect();
    while centers.len() < scene.uavs.len().min(users.len()) {
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
    let mut own = vec![Vec::new(); scene.uavs.len()];
    let mut free: Vec<usize> = (0..scene.uavs.len()).collect();
    for (center, group) in centers.iter().zip(groups) {
        let to = |i: &usize| distance(scene.uavs[free[*i]], *center);
        let nearest = (0..free.len()).min_by(|a, b| to(a).total_cmp(&to(b))).unwrap_or(0);
        own[free.remove(nearest)] = group;
    }
    own
}
