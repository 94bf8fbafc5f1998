//! Promotion: the alias that moves to the policy of a job that succeeds, and the condition of the move.

use serde_json::{Value, json};

use super::aliases::check_alias;
use crate::jobs::worker::RivalComparison;
use crate::policy::baselines;
use crate::serving::{PolicySpec, Registry};
use crate::store::WorkerResult;

/// The move of an alias when a job succeeds.
#[derive(Clone, Debug)]
pub(in crate::service) struct Promotion {
    /// The alias.
    pub alias: String,
    /// The policy that the new version must be better than; `None`: the alias moves in any case.
    pub better_than: Option<String>,
    /// The comparison with that policy; `None`: it did not exist when the worker asked for it.
    pub comparison: Option<RivalComparison>,
}

/// What a job that succeeds leaves besides its policy.
pub(in crate::service) struct JobResult<'a> {
    /// How its last attempt ended.
    pub ended: &'a WorkerResult,
    /// The move of an alias, which is then its result.
    pub promotion: Option<Promotion>,
    /// The result as JSON.
    pub document: Option<&'a str>,
}

/// Whether the alias moves, and why it does not.
pub(super) type Decision = Result<(), String>;

impl Promotion {
    /// Whether the alias of the policy `name` moves to a version with this digest, as policies are now.
    pub(super) fn decide(&self, registry: &Registry, name: &str, digest: &[u8; 32]) -> Decision {
        check_alias(registry, name, &self.alias).map_err(|e| e.reason())?;
        if registry.version_of_digest(name, digest).is_some_and(|known| !known.loaded) {
            return Err("the version is unloaded".into());
        }
        let Some(rival) = &self.better_than else { return Ok(()) };
        let found = rival.parse::<PolicySpec>().ok().and_then(|spec| registry.describe(&spec).ok());
        let version = found.map(|found| format!("{}:{}", found.state.reference.name, found.state.reference.version));
        let now = if baselines::is_name(rival) { Some(rival.clone()) } else { version };
        match (now, &self.comparison) {
            // Nothing is there that could be better.
            (None, _) => Ok(()),
            (Some(now), Some(comparison)) if now == comparison.policy => {
                if comparison.is_better() {
                    return Ok(());
                }
                match (comparison.mean_aoi, comparison.rival_mean_aoi) {
                    (Some(own), Some(other)) => Err(format!("mean AoI {own} is not lower than {other} of {now}")),
                    _ => Err(format!("{now} cannot fly in the environment of the job")),
                }
            }
            (Some(now), _) => Err(format!("{rival} is {now} by now, which the job was not compared with")),
        }
    }

    /// The result of a job: what became of its promotion.
    pub(super) fn document(&self, decision: &Decision) -> Value {
        json!({"publish": {
            "alias": self.alias, "promoted": decision.is_ok(), "reason": decision.as_ref().err(), "comparison": self.comparison,
        }})
    }
}
