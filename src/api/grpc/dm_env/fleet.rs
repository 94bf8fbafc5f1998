//! What the agent of a world acts and observes: one action and several observations, for all UAVs of the fleet.

use std::collections::HashMap;

use super::tensors::{at_least, bools, floats, heading_spec, integer, spec};
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::serving::{CopyObservation, EnvironmentState};
use crate::wire::dm::dm_env_rpc::v1 as wire;

/// The action.
pub(super) const HEADINGS: u64 = 1;
/// Most numbers of all observations of a slot.
const MAX_NUMBERS: usize = 1 << 20;

/// The observations. Their numbers are the ids in messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Observation {
    Observations = 1,
    UavPositions,
    UserPositions,
    UserAoi,
    UavPresent,
    UserPresent,
    Slot,
    Reward,
}

use Observation as O;

const ALL: [Observation; 8] =
    [O::Observations, O::UavPositions, O::UserPositions, O::UserAoi, O::UavPresent, O::UserPresent, O::Slot, O::Reward];

impl Observation {
    fn of(uid: u64) -> Option<Self> {
        ALL.into_iter().find(|&observation| observation as u64 == uid)
    }

    fn spec(self, config: &EnvConfig) -> wire::TensorSpec {
        use wire::DataType::{Bool, Float, Int64};
        let (m, n) = (config.uavs, config.users);
        match self {
            O::Observations => spec("observations", Float, &[m, width(config)]),
            O::UavPositions => spec("uav_positions", Float, &[m, 2]),
            O::UserPositions => spec("user_positions", Float, &[n, 2]),
            O::UserAoi => at_least(spec("user_aoi", Float, &[n]), 0.0),
            O::UavPresent => spec("uav_present", Bool, &[m]),
            O::UserPresent => spec("user_present", Bool, &[n]),
            O::Slot => spec("slot", Int64, &[]),
            O::Reward => spec("reward", Float, &[]),
        }
    }

    fn tensor(self, config: &EnvConfig, state: &EnvironmentState) -> wire::Tensor {
        let (m, n, copy) = (config.uavs, config.users, &state.copies[0]);
        let CopyObservation { scene, numbers, .. } = &copy.observation;
        // What is not there is at 0.
        let positions = |points: &[[f64; 2]], numbers: &[u32], all: usize| {
            let mut flat = vec![0.0; 2 * all];
            for (&number, point) in numbers.iter().zip(points) {
                flat[2 * number as usize..][..2].copy_from_slice(&point.map(|x| x as f32));
            }
            floats(flat, &[all, 2])
        };
        let present = |numbers: &[u32], all: usize| {
            let mut flags = vec![false; all];
            numbers.iter().for_each(|&number| flags[number as usize] = true);
            bools(flags, &[all])
        };
        match self {
            O::Observations => floats(observations(config, &copy.observation), &[m, width(config)]),
            O::UavPositions => positions(&scene.uavs, &numbers.0, m),
            O::UserPositions => positions(&scene.users, &numbers.1, n),
            O::UserAoi => {
                let mut aoi = vec![0.0; n];
                numbers.1.iter().zip(&scene.aoi).for_each(|(&j, &age)| aoi[j as usize] = age);
                floats(aoi, &[n])
            }
            O::UavPresent => present(&numbers.0, m),
            O::UserPresent => present(&numbers.1, n),
            O::Slot => integer(state.slot as i64),
            O::Reward => floats(vec![copy.reward], &[]),
        }
    }
}

/// Width of the observation of a UAV.
fn width(config: &EnvConfig) -> usize {
    2 + 2 * config.uavs + 3 * config.users
}

/// Per UAV its own position, the relative position of each UAV that it detects, and the relative position and AoI / K of each user; 0
/// where it detects nothing.
fn observations(config: &EnvConfig, observation: &CopyObservation) -> Vec<f32> {
    let (m, width) = (config.uavs, width(config));
    let mut all = vec![0.0; m * width];
    let CopyObservation { scene, graph, numbers: (uavs, users) } = observation;
    let Some(graph) = graph else { return all };
    for (i, (&uav, at)) in uavs.iter().zip(&scene.uavs).enumerate() {
        let row = &mut all[uav as usize * width..][..width];
        row[..2].copy_from_slice(&at.map(|x| x as f32));
        for detection in graph.detections(i) {
            let target = detection.target as usize;
            if let Some(j) = target.checked_sub(uavs.len()) {
                let cell = 2 + 2 * m + 3 * users[j] as usize;
                row[cell..cell + 2].copy_from_slice(&detection.rel);
                row[cell + 2] = scene.aoi[j] / config.slots as f32;
            } else {
                row[2 + 2 * uavs[target] as usize..][..2].copy_from_slice(&detection.rel);
            }
        }
    }
    all
}

/// Checks that observations of a fleet are not too large.
///
/// # Errors
/// [`Invalid`] for too many UAVs and users.
pub(super) fn check_size(config: &EnvConfig) -> Result<(), Invalid> {
    if config.uavs.saturating_mul(width(config)) <= MAX_NUMBERS {
        return Ok(());
    }
    let value = format!("{} UAVs and {} users", config.uavs, config.users);
    Err(Invalid::new("settings.uavs", value, format!("observations of at most {MAX_NUMBERS} numbers")))
}

/// The specifications of the actions and observations in a world.
pub(super) fn specs(config: &EnvConfig) -> wire::ActionObservationSpecs {
    wire::ActionObservationSpecs {
        actions: HashMap::from([(HEADINGS, heading_spec("headings", config.uavs, config.actions()))]),
        observations: ALL.into_iter().map(|observation| (observation as u64, observation.spec(config))).collect(),
    }
}

/// Checks the ids of requested observations.
///
/// # Errors
/// [`Invalid`] for the first unknown one.
pub(super) fn check_requested(requested: &[u64]) -> Result<(), Invalid> {
    match requested.iter().find(|&&uid| Observation::of(uid).is_none()) {
        None => Ok(()),
        Some(uid) => Err(Invalid::new("requested_observations", uid, format!("numbers from 1 to {}", ALL.len()))),
    }
}

/// The requested observations.
pub(super) fn observe(config: &EnvConfig, state: &EnvironmentState, requested: &[u64]) -> HashMap<u64, wire::Tensor> {
    let known = ALL.into_iter().filter(|&observation| requested.contains(&(observation as u64)));
    known.map(|observation| (observation as u64, observation.tensor(config, state))).collect()
}
