//! Disturbances of an evaluation: a UAV is lost, or observed positions have errors. Policies are not trained for them and not
//! informed about them. Without a disturbance, observations and random numbers are the same as in training.

use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::env::{EnvConfig, LostUav, Point};
use crate::invalid::{Invalid, in_range};
use crate::rng;

/// The disturbances of an evaluation; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Disturbance {
    /// The UAV that is lost during each episode. It remains in the fleet, and its headings are ignored.
    pub lose: Option<LostUav>,
    /// Standard deviation of the Gaussian error of each observed coordinate, drawn in every slot; in units of the square's side.
    /// Moves and collection use the true positions.
    pub position_noise: f64,
}

impl Disturbance {
    /// Checks the fields against the environment.
    ///
    /// # Errors
    /// The first field that is out of range.
    pub fn validate(&self, env: &EnvConfig) -> Result<(), Invalid> {
        in_range("position_noise", self.position_noise, 0.0..=1.0)?;
        let Some(lost) = self.lose else { return Ok(()) };
        in_range("lose.uav", lost.uav, 0..=env.uavs - 1)?;
        in_range("lose.slot", lost.slot, 0..=env.slots - 1)
    }

    /// Index of the UAV that is lost in `slot`.
    pub(super) fn lost(&self, env: &EnvConfig, slot: usize) -> Option<usize> {
        self.lose.or(env.lose_uav).filter(|lost| lost.slot <= slot).map(|lost| lost.uav)
    }

    /// Replaces the true positions in `slot` of the episode with this seed by the observed positions. `hide`: whether users that are not
    /// there are out of sight; policies that know all positions know where users will appear.
    pub(super) fn distort(
        &self,
        env: &EnvConfig,
        (seed, slot): (u64, usize),
        uavs: &mut [Point],
        users: &mut [Point],
        hide: bool,
    ) {
        if self.position_noise > 0.0 {
            let mut rng = rng::stream(seed, "position-noise", slot as u64);
            for x in uavs.iter_mut().chain(users.iter_mut()).flatten() {
                let error: f64 = StandardNormal.sample(&mut rng);
                // As in the environment, positions are f32, and range tests start from them.
                *x = f64::from((*x + self.position_noise * error) as f32);
            }
        }
        if let Some(uav) = self.lost(env, slot) {
            uavs[uav] = [undetectable(env, self.position_noise); 2];
        }
        if hide {
            for absent in env.user_slots.iter().filter(|user| !env.is_there(user.user, slot)) {
                users[absent.user] = [1.0 - undetectable(env, self.position_noise); 2];
            }
        }
    }
}

/// A coordinate that no node detects, so that policies need no rule for a lost UAV: further than the other UAVs can fly, plus the
/// largest detection range and the largest error (normal random numbers in f64 stay below 20).
fn undetectable(env: &EnvConfig, noise: f64) -> f64 {
    -(3.0 + env.slots as f64 * env.speed + 20.0 * noise)
}
