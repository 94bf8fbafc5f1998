//! What may go wrong in an evaluation that no policy was trained for: a UAV is lost, positions are measured badly.
//!
//! Policies are told neither. Nothing here changes what a policy with no disturbance sees, nor draws a random number for it.

use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::env::{EnvConfig, Point};
use crate::invalid::{Invalid, in_range};
use crate::rng;

/// What goes wrong; by default nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Disturbance {
    /// A UAV that is lost on the way.
    pub lose: Option<Loss>,
    /// Standard deviation of the Gaussian error of every coordinate that policies see, drawn anew each slot; in units of the
    /// square's side. Flight and collection go by the true positions.
    pub position_noise: f64,
}

/// From a slot on, a UAV neither moves, collects, sees nor is seen. The fleet still counts it; its headings are ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Loss {
    /// Which one, from 0.
    pub uav: usize,
    /// The first slot without it.
    pub slot: usize,
}

impl Disturbance {
    /// Checks that it fits the environment.
    ///
    /// # Errors
    /// The first field that does not.
    pub fn validate(&self, env: &EnvConfig) -> Result<(), Invalid> {
        in_range("position_noise", self.position_noise, 0.0..=1.0)?;
        let Some(loss) = self.lose else { return Ok(()) };
        in_range("lose.uav", loss.uav, 0..=env.uavs - 1)?;
        in_range("lose.slot", loss.slot, 0..=env.slots - 1)
    }

    /// The UAV that is missing in `slot`.
    pub(super) fn lost(&self, slot: usize) -> Option<usize> {
        self.lose.filter(|loss| loss.slot <= slot).map(|loss| loss.uav)
    }

    /// Turns the true positions in `slot` of the episode with this seed into what policies see.
    pub(super) fn distort(&self, env: &EnvConfig, seed: u64, slot: usize, uavs: &mut [Point], users: &mut [Point]) {
        if self.position_noise > 0.0 {
            let mut rng = rng::stream(seed, "position-noise", slot as u64);
            for x in uavs.iter_mut().chain(users).flatten() {
                let error: f64 = StandardNormal.sample(&mut rng);
                // As in the environment, positions are f32 and all tests of range start from them.
                *x = f64::from((*x + self.position_noise * error) as f32);
            }
        }
        if let Some(uav) = self.lost(slot) {
            uavs[uav] = [away(env, self.position_noise); 2];
        }
    }
}

/// A coordinate out of everybody's sight, so that a lost UAV needs no rule of its own in any policy: beyond what the others
/// can fly to, by more than the largest detection range and any error (a normal number drawn from f64s stays below 20).
fn away(env: &EnvConfig, noise: f64) -> f64 {
    -(3.0 + env.slots as f64 * env.speed + 20.0 * noise)
}
