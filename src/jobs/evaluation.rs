//! Evaluations: jobs that compare policies on frozen layouts, as `qedgix evaluate` does.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::env::EnvConfig;
use crate::invalid::{Invalid, count_in_range, in_range};
use crate::learner::{Comparison, Disturbance, LostUav, SizingTarget, layout_list};
use crate::policy::baselines;
use crate::train_config::parse_environment;

/// Most policies of an evaluation.
const MAX_POLICIES: usize = 32;

/// An evaluation as it is submitted; what is absent has a default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationRequest {
    /// The policies to compare: NAME, NAME@ALIAS, NAME:VERSION, or baselines.
    pub policies: Vec<String>,
    /// Name of the list of layouts; default: eval-v1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layouts: Option<String>,
    /// Number of layouts, from the first; default: 256.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub episodes: Option<usize>,
    /// A UAV that is lost; default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lose: Option<LostUav>,
    /// Standard deviation of the error of each observed coordinate; default: 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_noise: Option<f64>,
    /// Fleets of growing size instead of one; default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan: Option<PlanRequest>,
}

/// Fleet sizing, as it is submitted; what is absent has a default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanRequest {
    /// 95th percentile of AoI over users and slots that the fleet must keep, in slots.
    pub target_p95: f64,
    /// Largest fleet to try; default: 12.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_uavs: Option<usize>,
    /// Whether a UAV is lost at each of several times; default: no.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failures: Option<bool>,
}

impl PlanRequest {
    fn resolve(self, policies: usize, disturbance: &Disturbance) -> Result<SizingTarget, Invalid> {
        if policies != 1 {
            return Err(Invalid::new("policies", format!("{policies} policies"), "one policy, whose fleet is sized"));
        }
        if *disturbance != Disturbance::default() {
            let expected = "no lose and no position_noise: a plan has losses of its own (failures)";
            return Err(Invalid::new("plan", "a value beside a disturbance", expected));
        }
        let Self { target_p95, max_uavs, failures } = self;
        let target = SizingTarget { target_p95, max_uavs: max_uavs.unwrap_or(12), failures: failures.unwrap_or(false) };
        target.validate().map_err(|e| e.with_prefix("plan"))?;
        Ok(target)
    }
}

/// An evaluation with all defaults filled in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationSpec {
    /// The policies to compare: baselines, and versions as NAME:VERSION.
    pub policies: Vec<String>,
    /// Name of the list of layouts.
    pub layouts: String,
    /// Number of layouts, from the first.
    pub episodes: usize,
    /// The environment, except for `hover`, which depends on the policy.
    pub environment: EnvConfig,
    /// The disturbance.
    pub disturbance: Disturbance,
    /// Fleet sizing with the only policy; `environment.uavs` has no effect then.
    #[serde(default)]
    pub plan: Option<SizingTarget>,
}

impl EvaluationRequest {
    /// The evaluation in an environment with these fields.
    ///
    /// # Errors
    /// The first field that is not accepted.
    pub fn resolve(self, environment: &Map<String, Value>) -> Result<EvaluationSpec, Invalid> {
        let Self { policies, layouts, episodes, lose, position_noise, plan } = self;
        count_in_range("evaluation.policies", policies.len(), 1..=MAX_POLICIES, "policies")?;
        let mut environment = parse_environment(Value::Object(environment.clone()))?;
        // Rewards are not part of an evaluation.
        environment.reward_scale = None;
        let list = layout_list(layouts.as_deref().unwrap_or("eval-v1")).map_err(|e| e.with_prefix("evaluation"))?;
        let episodes = episodes.unwrap_or(256);
        in_range("evaluation.episodes", episodes as u64, 1..=list.episodes)?;
        let disturbance = Disturbance { lose, position_noise: position_noise.unwrap_or(0.0) };
        if list.mixed && disturbance != Disturbance::default() {
            let expected = "a list that is not mixed, because disturbances belong to one fleet";
            return Err(Invalid::new("evaluation.layouts", list.name, expected));
        }
        disturbance.validate(&environment).map_err(|e| e.with_prefix("evaluation"))?;
        if list.mixed && plan.is_some() {
            let expected = "a list that is not mixed, because a plan chooses the fleets";
            return Err(Invalid::new("evaluation.layouts", list.name, expected));
        }
        let plan = plan.map(|plan| plan.resolve(policies.len(), &disturbance)).transpose();
        let plan = plan.map_err(|e| e.with_prefix("evaluation"))?;
        Ok(EvaluationSpec { policies, layouts: list.name.to_owned(), episodes, environment, disturbance, plan })
    }
}

impl EvaluationSpec {
    /// All policies with whether they are references that were not asked for.
    pub fn all_policies(&self) -> Vec<(&str, bool)> {
        if self.plan.is_some() {
            return self.policies.iter().map(|name| (name.as_str(), false)).collect();
        }
        let references = Comparison::REFERENCES.iter().copied();
        let references = references
            .filter(|name| !self.policies.iter().any(|p| p == name))
            .filter(|name| baselines::by_name(name, (&self.environment).into()).is_some());
        self.policies.iter().map(|name| (name.as_str(), false)).chain(references.map(|name| (name, true))).collect()
    }

    /// The amount of work: layouts of all policies, or of all fleets.
    pub fn steps(&self) -> u64 {
        let fleets = self.plan.map_or_else(|| self.all_policies().len(), |plan| plan.evaluations(self.environment.slots));
        (self.episodes * fleets) as u64
    }
}
