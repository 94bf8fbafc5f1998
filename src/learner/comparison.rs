//! Policies evaluated on the same layouts: summaries, paired differences, gaps to reference policies.

use serde_json::{Value, json};

use super::{Difference, Disturbance, LayoutList, Summary, TracedEvaluation, difference, summarize};
use crate::env::EnvConfig;
use crate::invalid::Invalid;

/// A policy and its evaluation.
pub struct PolicyEvaluation {
    /// The name given on the command line.
    pub name: String,
    /// Whether it was added for comparison and not requested.
    pub reference: bool,
    /// Statistics over layouts.
    pub summary: Summary,
    /// The evaluation; through a server, it has the metrics of the episodes only.
    pub evaluation: TracedEvaluation,
}

impl PolicyEvaluation {
    /// Summarizes an evaluation.
    ///
    /// # Errors
    /// There are no episodes.
    pub fn new(name: &str, reference: bool, evaluation: TracedEvaluation) -> Result<Self, Invalid> {
        Ok(Self { name: name.to_owned(), reference, summary: summarize(&evaluation.episodes)?, evaluation })
    }
}

/// An evaluation of several policies.
pub struct Comparison {
    /// The list of layouts.
    pub layouts: LayoutList,
    /// Number of layouts, from the first.
    pub episodes: usize,
    /// The environment, except for `hover`, which depends on the policy.
    pub env: EnvConfig,
    /// The disturbance.
    pub disturbance: Disturbance,
    /// The policies in the order of the command line, then the references.
    pub policies: Vec<PolicyEvaluation>,
}

/// Two policies and the difference first minus second.
pub type Pair<'a> = (&'a PolicyEvaluation, &'a PolicyEvaluation, Difference);

impl Comparison {
    /// Policies to compare with (docs/model.md, "Evaluation"): a planner with full information, and rules with local information.
    pub const REFERENCES: [&'static str; 2] = ["tour", "sweep"];

    /// The policies, the best first.
    pub fn best_first(&self) -> Vec<&PolicyEvaluation> {
        let mut policies: Vec<&PolicyEvaluation> = self.policies.iter().collect();
        policies.sort_by(|a, b| a.summary.mean_aoi.mean.total_cmp(&b.summary.mean_aoi.mean));
        policies
    }

    /// Every pair of requested policies.
    ///
    /// # Errors
    /// Two policies have different numbers of episodes.
    pub fn pairs(&self) -> Result<Vec<Pair<'_>>, Invalid> {
        let requested: Vec<&PolicyEvaluation> = self.policies.iter().filter(|f| !f.reference).collect();
        let mut pairs = Vec::new();
        for (i, first) in requested.iter().enumerate() {
            for second in &requested[i + 1..] {
                pairs.push((*first, *second, difference(&first.evaluation.episodes, &second.evaluation.episodes)?));
            }
        }
        Ok(pairs)
    }

    /// Every policy minus the policy `name`, the best first, including `name` itself; empty if `name` was not evaluated.
    ///
    /// # Errors
    /// Two policies have different numbers of episodes.
    pub fn gaps(&self, name: &str) -> Result<Vec<Pair<'_>>, Invalid> {
        let Some(reference) = self.policies.iter().find(|policy| policy.name == name) else { return Ok(Vec::new()) };
        let policies = self.best_first().into_iter();
        policies
            .map(|policy| Ok((policy, reference, difference(&policy.evaluation.episodes, &reference.evaluation.episodes)?)))
            .collect()
    }

    /// The conditions of the evaluation in one line.
    pub fn conditions(&self) -> String {
        let Self { env, disturbance, .. } = self;
        if self.layouts.mixed {
            return format!("{} of {}, with drawn sizes, ranges and horizons", self.episodes, self.layouts.name);
        }
        let mut parts = vec![
            format!("{} of {}", self.episodes, self.layouts.name),
            format!("{} UAVs", env.uavs),
            format!("{} users", env.users),
            format!("{} slots", env.slots),
        ];
        if env.detection_range != EnvConfig::default().detection_range {
            parts.push(format!("detection range {}", env.detection_range));
        }
        parts.extend(env.communication_range.map(|range| format!("communication range {range}")));
        parts.extend(disturbance.lose.map(|lost| format!("UAV {} lost from slot {} on", lost.uav, lost.slot)));
        if disturbance.position_noise > 0.0 {
            parts.push(format!("observed positions with an error of {}", disturbance.position_noise));
        }
        parts.join(", ")
    }

    /// The evaluation as JSON.
    ///
    /// # Errors
    /// Two policies have different numbers of episodes.
    pub fn json(&self) -> Result<Value, Invalid> {
        let rows = |reference: bool| -> Vec<Value> {
            let policies = self.policies.iter().filter(|policy| policy.reference == reference);
            policies.map(|policy| json!({"policy": policy.name, "summary": policy.summary})).collect()
        };
        let pairs = self.pairs()?;
        let pairs = pairs.iter().map(|(a, b, d)| json!({"first": a.name, "second": b.name, "difference": d}));
        let mut gaps = Vec::new();
        for name in Self::REFERENCES {
            let others = self.gaps(name)?.into_iter().filter(|(policy, reference, _)| policy.name != reference.name);
            gaps.extend(
                others.map(|(policy, reference, d)| json!({"policy": policy.name, "reference": reference.name, "difference": d})),
            );
        }
        Ok(json!({
            "layouts": self.layouts.name,
            "episodes": self.episodes,
            "environment": self.env,
            "disturbance": self.disturbance,
            "policies": rows(false),
            "references": rows(true),
            "differences": pairs.collect::<Vec<_>>(),
            "gaps": gaps,
        }))
    }
}
