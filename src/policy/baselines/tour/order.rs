//! Short cyclic tours through points: nearest neighbour, then 2-opt and Or-opt. Work is bounded for any number of points.

use crate::env::Point;
use crate::policy::flight::distance;

/// Maximum number of points for which the first tour is by nearest neighbour, which compares all pairs. Larger tours start row
/// by row.
const PAIRWISE: usize = 2048;
/// Maximum distance along the tour between two points that an improvement exchanges.
const WINDOW: usize = 48;
/// Maximum number of rounds of improvements.
const ROUNDS: usize = 12;
/// Maximum number of points times rounds.
const WORK: usize = 20_000;

/// Reorders `tour` into a short cyclic tour.
pub fn shorten(tour: &mut [u32], users: &[Point]) {
    let n = tour.len();
    if n < 4 {
        return;
    }
    if n > PAIRWISE {
        by_rows(tour, users);
    } else {
        by_neighbour(tour, users);
    }
    for _ in 0..ROUNDS.min(WORK / n) {
        if !(two_opt(tour, users) | or_opt(tour, users)) {
            break;
        }
    }
}

fn between(tour: &[u32], users: &[Point], i: usize, j: usize) -> f64 {
    let n = tour.len();
    distance(users[tour[i % n] as usize], users[tour[j % n] as usize])
}

/// Each point is followed by the nearest point that remains.
fn by_neighbour(tour: &mut [u32], users: &[Point]) {
    for i in 1..tour.len() {
        let nearest = (i..tour.len()).min_by(|&a, &b| between(tour, users, i - 1, a).total_cmp(&between(tour, users, i - 1, b)));
        tour.swap(i, nearest.unwrap_or(i));
    }
}

/// Rows of points, each traversed in the direction opposite to the row before.
fn by_rows(tour: &mut [u32], users: &[Point]) {
    let rows = (tour.len() as f64).sqrt().ceil().max(1.0);
    let key = |&user: &u32| {
        let [x, y] = users[user as usize];
        let row = (y * rows).floor();
        (row, if row.rem_euclid(2.0) < 1.0 { x } else { -x })
    };
    tour.sort_by(|a, b| key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)).then(a.cmp(b)));
}

/// 2-opt: reverses parts of the tour. Returns whether the tour became shorter.
fn two_opt(tour: &mut [u32], users: &[Point]) -> bool {
    let n = tour.len();
    let mut better = false;
    for i in 0..n - 1 {
        for j in i + 2..n.min(i + 2 + WINDOW) {
            let now = between(tour, users, i, i + 1) + between(tour, users, j, j + 1);
            let then = between(tour, users, i, j) + between(tour, users, i + 1, j + 1);
            if then < now - 1e-12 {
                tour[i + 1..=j].reverse();
                better = true;
            }
        }
    }
    better
}

/// Or-opt: moves single points along the tour. Returns whether the tour became shorter.
fn or_opt(tour: &mut [u32], users: &[Point]) -> bool {
    let n = tour.len();
    let mut better = false;
    for i in 1..n - 1 {
        for j in (0..n - 1).skip(i.saturating_sub(WINDOW)).take(2 * WINDOW) {
            if j + 1 == i || j == i {
                continue;
            }
            let now = between(tour, users, i - 1, i) + between(tour, users, i, i + 1) + between(tour, users, j, j + 1);
            let then = between(tour, users, i - 1, i + 1) + between(tour, users, j, i) + between(tour, users, i, j + 1);
            if then < now - 1e-12 {
                if j < i {
                    tour[j + 1..=i].rotate_right(1);
                } else {
                    tour[i..=j].rotate_left(1);
                }
                better = true;
            }
        }
    }
    better
}
