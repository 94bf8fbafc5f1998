//! Moving users (`user_speed`): constant speed, a direction that changes slightly in each slot, reflection at the border of the
//! square.

use std::f64::consts::{FRAC_PI_8, PI, TAU};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::rng;

/// The movement of one episode's users.
#[derive(Clone, Debug)]
pub(super) struct RandomWalk {
    rng: ChaCha8Rng,
    speed: f64,
    /// Direction of each user in radians.
    directions: Vec<f64>,
}

impl RandomWalk {
    /// Maximum change of direction per slot, in radians.
    const MAX_TURN: f64 = FRAC_PI_8;

    pub(super) fn new(seed: u64, users: usize, speed: f64) -> Self {
        let mut rng = rng::stream(seed, "walk", 0);
        let directions = (0..users).map(|_| rng.random_range(0.0..TAU)).collect();
        Self { rng, speed, directions }
    }

    /// Moves every user in `xy` (N, 2) for one slot.
    pub(super) fn step(&mut self, xy: &mut [f32]) {
        for (xy, direction) in xy.chunks_exact_mut(2).zip(&mut self.directions) {
            *direction += self.rng.random_range(-Self::MAX_TURN..=Self::MAX_TURN);
            let x = f64::from(xy[0]) + self.speed * direction.cos();
            let y = f64::from(xy[1]) + self.speed * direction.sin();
            if !(0.0..=1.0).contains(&x) {
                *direction = PI - *direction;
            }
            if !(0.0..=1.0).contains(&y) {
                *direction = -*direction;
            }
            xy[0] = reflect(x) as f32;
            xy[1] = reflect(y) as f32;
        }
    }
}

/// Reflects a coordinate into [0, 1]. A step is at most 1 long, so one reflection is enough.
fn reflect(x: f64) -> f64 {
    let x = if x < 0.0 { -x } else { x };
    if x > 1.0 { 2.0 - x } else { x }
}
