//! Policies flown on the same layouts, and what can be said about them: summaries, paired differences, gaps to references.

use serde_json::{Value, json};

use crate::env::EnvConfig;
use crate::learner::{Difference, Disturbance, Layouts, Summary, Survey, difference, summarize};

/// A policy and its flights.
pub struct Flown {
    /// As it was asked for.
    pub name: String,
    /// Whether it flew only to be compared with.
    pub reference: bool,
    /// Means over layouts.
    pub summary: Summary,
    /// The flights; through a server only the figures of the episodes are known.
    pub survey: Survey,
}

impl Flown {
    /// # Errors
    /// There are no episodes.
    pub fn new(name: &str, reference: bool, survey: Survey) -> anyhow::Result<Self> {
        Ok(Self { name: name.to_owned(), reference, summary: summarize(&survey.episodes)?, survey })
    }
}

/// An evaluation.
pub struct Comparison {
    /// The list of layouts.
    pub layouts: Layouts,
    /// How many of them, from the first.
    pub episodes: usize,
    /// The environment; `hover` is as each policy needs it.
    pub env: EnvConfig,
    /// What went wrong on purpose.
    pub disturbance: Disturbance,
    /// The policies, as they were asked for; references last.
    pub flown: Vec<Flown>,
}

/// Two policies and first minus second.
pub type Pair<'a> = (&'a Flown, &'a Flown, Difference);

impl Comparison {
    /// What policies are measured against (spec 7): the reference planner, and the rule that knows no more than they do.
    pub const REFERENCES: [&'static str; 2] = ["tour", "sweep"];

    /// The policies, the best first.
    pub fn best_first(&self) -> Vec<&Flown> {
        let mut flown: Vec<&Flown> = self.flown.iter().collect();
        flown.sort_by(|a, b| a.summary.mean_aoi.mean.total_cmp(&b.summary.mean_aoi.mean));
        flown
    }

    /// Every pair of the policies that were asked for.
    ///
    /// # Errors
    /// Policies flew different numbers of layouts.
    pub fn pairs(&self) -> anyhow::Result<Vec<Pair<'_>>> {
        let asked: Vec<&Flown> = self.flown.iter().filter(|f| !f.reference).collect();
        let mut pairs = Vec::new();
        for (i, first) in asked.iter().enumerate() {
            for second in &asked[i + 1..] {
                pairs.push((*first, *second, difference(&first.survey.episodes, &second.survey.episodes)?));
            }
        }
        Ok(pairs)
    }

    /// Every policy, the best first, minus the reference called `name`, itself among them; none when that did not fly.
    ///
    /// # Errors
    /// Policies flew different numbers of layouts.
    pub fn gaps(&self, name: &str) -> anyhow::Result<Vec<Pair<'_>>> {
        let Some(reference) = self.flown.iter().find(|f| f.name == name) else { return Ok(Vec::new()) };
        let flown = self.best_first().into_iter();
        flown.map(|f| Ok((f, reference, difference(&f.survey.episodes, &reference.survey.episodes)?))).collect()
    }

    /// What was flown, in one line.
    pub fn conditions(&self) -> String {
        let Self { env, disturbance, .. } = self;
        let mut line =
            format!("{} of {}, {} UAVs, {} users, {} slots", self.episodes, self.layouts.name, env.uavs, env.users, env.slots);
        if let Some(loss) = disturbance.lose {
            line += &format!(", UAV {} lost from slot {} on", loss.uav, loss.slot);
        }
        if disturbance.position_noise > 0.0 {
            line += &format!(", positions seen with an error of {}", disturbance.position_noise);
        }
        line
    }

    /// Everything as JSON.
    ///
    /// # Errors
    /// Policies flew different numbers of layouts.
    pub fn json(&self) -> anyhow::Result<Value> {
        let rows = |reference: bool| -> Vec<Value> {
            let flown = self.flown.iter().filter(|f| f.reference == reference);
            flown.map(|f| json!({"policy": f.name, "summary": f.summary})).collect()
        };
        let pairs = self.pairs()?;
        let pairs = pairs.iter().map(|(a, b, d)| json!({"first": a.name, "second": b.name, "difference": d}));
        let mut gaps = Vec::new();
        for name in Self::REFERENCES {
            let others = self.gaps(name)?.into_iter().filter(|(f, reference, _)| f.name != reference.name);
            gaps.extend(others.map(|(f, r, d)| json!({"policy": f.name, "reference": r.name, "difference": d})));
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
