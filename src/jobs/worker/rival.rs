//! Compares the best checkpoint of a job with the policy that it must be better than, on the same layouts.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use serde::{Deserialize, Serialize};

use crate::checkpoint::Checkpoint;
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::learner::{Disturbance, evaluate_until, layout_list};
use crate::policy::{Policy, baselines};

/// The list of layouts, and their number.
const LAYOUTS: (&str, usize) = ("eval-v1", 256);

/// The result of a comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RivalComparison {
    /// The rival: `NAME:VERSION`, or a baseline.
    pub policy: String,
    /// Name of the list of layouts.
    pub layouts: String,
    /// Number of layouts, from the first.
    pub episodes: usize,
    /// Mean AoI of the job's best checkpoint.
    pub mean_aoi: Option<f64>,
    /// Mean AoI of the rival; `None`: it cannot fly in the environment of the job.
    pub rival_mean_aoi: Option<f64>,
}

impl RivalComparison {
    /// Whether the job is better.
    pub fn is_better(&self) -> bool {
        self.mean_aoi.zip(self.rival_mean_aoi).is_some_and(|(own, rival)| own < rival)
    }
}

/// Compares `best` with the rival, whose checkpoint is empty for a baseline. `None`: `stop` was set meanwhile.
pub(super) fn compare(
    best: &Checkpoint,
    rival: &(String, Vec<u8>),
    threads: usize,
    stop: &Arc<AtomicBool>,
) -> Option<RivalComparison> {
    let env = &best.config().environment;
    let own = mean_aoi(&best.policy(), env, threads, stop)?;
    let other = match open(rival, env) {
        Some(policy) => mean_aoi(policy.as_ref(), env, threads, stop)?,
        None => None,
    };
    let (layouts, episodes) = (LAYOUTS.0.to_owned(), LAYOUTS.1);
    Some(RivalComparison { policy: rival.0.clone(), layouts, episodes, mean_aoi: own, rival_mean_aoi: other })
}

fn open((name, bytes): &(String, Vec<u8>), env: &EnvConfig) -> Option<Arc<dyn Policy>> {
    if bytes.is_empty() {
        return baselines::by_name(name, env.into());
    }
    Some(Arc::new(Checkpoint::from_bytes(bytes).ok()?.policy()))
}

/// The mean AoI of a policy; the inner `None`: it cannot fly in this environment.
#[allow(clippy::option_option, reason = "stopped, and not able to fly")]
fn mean_aoi(policy: &dyn Policy, env: &EnvConfig, threads: usize, stop: &Arc<AtomicBool>) -> Option<Option<f64>> {
    let env = EnvConfig { hover: policy.actions() > EnvConfig::COMPASS, ..env.clone() };
    let seeds = layout_list(LAYOUTS.0).expect("the list exists").seeds(LAYOUTS.1);
    match evaluate_until(policy, &env, &seeds, threads, &Disturbance::default(), stop) {
        Ok(Some(episodes)) => Some(Some(EpisodeMetrics::mean(&episodes).mean_aoi)),
        Ok(None) => None,
        Err(_) => Some(None),
    }
}
