//! The flags that describe the world in which policies are evaluated, shared by `evaluate`, `plan` and `audit`.

use clap::Args;

use crate::env::EnvConfig;

/// Users, slots and ranges.
#[derive(Args, Clone, Debug)]
pub struct WorldArgs {
    /// Number of users
    #[arg(long, env = "QEDGIX_USERS", default_value_t = 5)]
    pub users: usize,
    /// Slots per episode
    #[arg(long, env = "QEDGIX_SLOTS", default_value_t = 80)]
    pub slots: usize,
    /// Detection range, in units of the square's side
    #[arg(long, env = "QEDGIX_DETECTION_RANGE", default_value_t = 0.28)]
    pub detection_range: f64,
    /// Range within which UAVs exchange messages, in units of the square's side [default: the detection range]
    #[arg(long, env = "QEDGIX_COMMUNICATION_RANGE")]
    pub communication_range: Option<f64>,
    /// Transmission range, in units of the square's side
    #[arg(long, env = "QEDGIX_TRANSMISSION_RANGE", default_value_t = 0.12)]
    pub transmission_range: f64,
}

impl WorldArgs {
    /// The environment with `uavs` UAVs. Ranges are not checked.
    pub fn environment(&self, uavs: usize) -> EnvConfig {
        EnvConfig {
            uavs,
            users: self.users,
            slots: self.slots,
            detection_range: self.detection_range,
            communication_range: self.communication_range,
            transmission_range: self.transmission_range,
            ..EnvConfig::default()
        }
    }
}
