//! The configuration of a training run: algorithm, preset, and all resolved fields (docs/model.md, "Presets").
//!
//! `learner` trains from it, and `checkpoint` stores it with the parameters. This file has presets and the checks of the whole; `training` has the fields
//! of learning, `document` reads documents, `vary` draws environments.

mod document;
mod training;
mod vary;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use self::document::overridden;
pub use self::document::{MAX_EXACT_INTEGER, environment_with, field_name, floats_to_integers, parse_environment};
pub use self::training::Training;
use self::training::{MAX_STEPS, default_teacher_share};
pub use self::vary::Vary;
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::policy::mixer::MixerKind;
use crate::policy::{Advice, AgentConfig, Aggregation, Dims, Gnn, Identity, LearnedPolicy, Memory, ObservationKind, Trained};

/// The algorithms of the paper, and common baselines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Algorithm {
    /// GRU agents, monotonic mixing.
    Qmix,
    /// GRU agents, summed values.
    Vdn,
    /// GRU agents, each with its own target.
    Iql,
    /// GRU and `EdgeConv` agents, monotonic mixing: the paper's method.
    #[default]
    Qedgix,
    /// The paper's Algorithm 3.
    Agggnn,
    /// The paper's Algorithm 4.
    Rgcn,
}

/// Presets: named configurations that fields can override (docs/model.md, "Presets").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// As in the paper.
    Paper,
    /// As in the code of the paper's authors.
    Authors,
    /// The best results in our experiments.
    #[default]
    Practical,
}

/// The value of `teacher` that removes the teacher of a preset.
const NO_TEACHER: &str = "none";

/// The resolved configuration of a training run. With the code and the kind of processor, it fixes every metric and weight bit for
/// bit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Algorithm.
    pub algorithm: Algorithm,
    /// Preset of the fields that were not overridden.
    pub preset: Preset,
    /// Environment.
    pub environment: EnvConfig,
    /// Learning.
    pub training: Training,
    /// Seed of every random stream.
    pub seed: u64,
}

impl Algorithm {
    /// The graph layer of its agents.
    pub fn gnn(self) -> Gnn {
        match self {
            Self::Qmix | Self::Vdn | Self::Iql => Gnn::None,
            Self::Qedgix => Gnn::EdgeConv,
            Self::Agggnn => Gnn::AggGnn,
            Self::Rgcn => Gnn::Rgcn,
        }
    }
}

impl TrainConfig {
    /// Most environment steps of a run.
    pub const MAX_STEPS: u64 = MAX_STEPS;

    /// The configuration of `algorithm` and `preset` without overrides.
    pub fn preset(algorithm: Algorithm, preset: Preset) -> Self {
        let mut environment = EnvConfig::default();
        let mut training = Training {
            observation: ObservationKind::Flat,
            identity: Identity::Onehot,
            aggregation: Aggregation::Mean,
            layers: 2,
            self_position: false,
            self_loops: false,
            hops: 1,
            normalise: false,
            memory: Memory::None,
            advice: Advice::None,
            advice_margin: 0.0,
            mixer: MixerKind::Invariant,
            hyper_init: 1.0,
            steps: 2_050_000,
            learning_rate: 5e-3,
            learning_rate_decay: 1.0,
            gamma: 0.99,
            lambda: 0.6,
            clip: 10.0,
            epsilon_end: 0.05,
            epsilon_anneal: 100_000,
            batch: 128,
            updates_per_iteration: 1,
            envs: 8,
            buffer: 5000,
            target_every: 200,
            target_tau: 0.0,
            average: 0,
            shaping: false,
            augment: false,
            teacher: None,
            teacher_share: default_teacher_share(),
            vary: Vary::default(),
            eval_every: 10_000,
            eval_episodes: 64,
        };
        match preset {
            Preset::Paper => training.aggregation = Aggregation::Sum,
            Preset::Authors => {
                training.mixer = MixerKind::Qmix;
                training.clip = 20.0;
                environment.hover = true;
            }
            Preset::Practical => {
                training.observation = ObservationKind::Set;
                training.identity = Identity::Phase;
                training.memory = Memory::Shared;
                training.advice = Advice::Sweep;
                training.advice_margin = 0.03;
                training.teacher = Some("sweep-shared".to_owned());
                training.self_position = true;
                training.learning_rate = 1e-3;
                training.learning_rate_decay = 0.1;
                training.gamma = 0.95;
                training.lambda = 0.8;
                training.batch = 32;
                training.updates_per_iteration = 4;
                training.target_tau = 0.01;
                training.average = 500;
                training.shaping = true;
                training.eval_episodes = 128;
            }
        }
        match algorithm {
            Algorithm::Vdn => training.mixer = MixerKind::Vdn,
            Algorithm::Iql => training.mixer = MixerKind::None,
            _ => {}
        }
        Self { algorithm, preset, environment, training, seed: 1 }
    }

    /// The preset with the fields of `environment` and `training` overridden, checked as a whole.
    ///
    /// # Errors
    /// [`Invalid`] for a field that is unknown, of the wrong type or out of range; the field is named as `training.batch`.
    pub fn resolve(
        algorithm: Algorithm,
        preset: Preset,
        environment: &Map<String, Value>,
        training: &Map<String, Value>,
        seed: u64,
    ) -> Result<Self, Invalid> {
        let mut config = Self { seed, ..Self::preset(algorithm, preset).with_fields(environment, training)? };
        if config.training.teacher.as_deref() == Some(NO_TEACHER) {
            config.training.teacher = None;
        }
        // The advice of a preset needs the memory of the preset.
        if config.training.memory.is_none() && !training.contains_key("advice") {
            config.training.advice = Advice::None;
        }
        if config.training.advice.is_none() && !training.contains_key("advice_margin") {
            config.training.advice_margin = 0.0;
        }
        if config.environment.reward_scale.is_none() {
            let env = &config.environment;
            let scale = if preset == Preset::Authors { env.users as f64 } else { env.effective_reward_scale() };
            config.environment.reward_scale = Some(scale);
        }
        config.validate()?;
        Ok(config)
    }

    /// This configuration with other values of some fields. Their ranges and combination are not checked.
    ///
    /// # Errors
    /// [`Invalid`] for the first field that is unknown or of the wrong type.
    pub fn with_fields(&self, environment: &Map<String, Value>, training: &Map<String, Value>) -> Result<Self, Invalid> {
        Ok(Self {
            environment: overridden("environment", &self.environment, environment)?,
            training: overridden("training", &self.training, training)?,
            ..self.clone()
        })
    }

    /// The architecture of the agents.
    pub fn agent(&self) -> AgentConfig {
        let t = &self.training;
        AgentConfig {
            gnn: self.algorithm.gnn(),
            layers: t.layers,
            aggregation: t.aggregation,
            observation: t.observation,
            identity: t.identity,
            self_position: t.self_position,
            self_loops: t.self_loops,
            hops: t.hops,
            normalise: t.normalise,
            memory: t.memory,
            advice: t.advice,
        }
    }

    /// The policy of agents with these parameters.
    ///
    /// # Errors
    /// [`Invalid`] if the number of parameters does not fit the architecture, or one is not finite.
    pub fn policy(&self, parameters: Vec<f32>) -> Result<LearnedPolicy, Invalid> {
        let policy = LearnedPolicy::new(self.agent(), self.dims(), parameters)?;
        let t = &self.training;
        let trained = Trained {
            most_uavs: t.vary.largest(&self.environment).uavs,
            least_detection_range: t.vary.detection_range.map_or(self.environment.detection_range, |[least, _]| least),
        };
        Ok(policy.with_advice_margin(t.advice_margin as f32).with_trained(trained))
    }

    /// Environment steps after which training ends: the steps rounded up to whole iterations of all environments. Where training
    /// draws the number of slots, the steps themselves: the end depends on the draws.
    pub fn total_steps(&self) -> u64 {
        let (t, slots) = (&self.training, self.environment.slots);
        let iteration = if t.vary.slots.is_some() { 1 } else { (t.envs * slots).max(1) as u64 };
        t.steps.div_ceil(iteration).saturating_mul(iteration)
    }

    /// The sizes of the agents.
    pub fn dims(&self) -> Dims {
        let env = &self.environment;
        Dims { uavs: env.uavs, users: env.users, env: env.into() }
    }

    /// Checks each field and their combination.
    ///
    /// # Errors
    /// [`Invalid`] for the first invalid field.
    pub fn validate(&self) -> Result<(), Invalid> {
        /// Maximum size of replay in bytes.
        const MAX_REPLAY_BYTES: usize = 8 << 30;
        self.environment.validate().map_err(|e| e.with_prefix("environment"))?;
        self.training.validate().map_err(|e| e.with_prefix("training"))?;
        let mixes = self.training.mixer != MixerKind::None;
        if mixes == (self.algorithm == Algorithm::Iql) {
            let expected = if mixes { "none, because iql has no mixer" } else { "qmix, invariant or vdn" };
            return Err(Invalid::new("training.mixer", if mixes { "a mixer" } else { "none" }, expected));
        }
        let (env, t) = (&self.environment, &self.training);
        if env.changes() {
            let field = if env.lose_uav.is_some() { "environment.lose_uav" } else { "environment.user_slots" };
            return Err(Invalid::new(
                field,
                "a fleet that changes",
                "no value, because training has a fixed fleet; for hosted environments",
            ));
        }
        if t.hops > 1 && self.algorithm.gnn() != Gnn::None {
            return Err(Invalid::new(
                "training.hops",
                t.hops,
                "1, because the number of layers of a graph network sets its hops",
            ));
        }
        if !t.advice.is_none() && t.memory.is_none() {
            return Err(Invalid::new("training.advice", "sweep", "none, because the rule needs training.memory"));
        }
        if t.advice_margin > 0.0 && t.advice.is_none() {
            return Err(Invalid::new("training.advice_margin", t.advice_margin, "0, because training.advice is none"));
        }
        if !t.vary.is_none() {
            self.validate_vary()?;
        }
        let env = t.vary.largest(env);
        let episode = (env.slots + 1) * (env.uavs * 8 + env.users * 10) + env.slots * (env.uavs + 4);
        let replay = episode.saturating_mul(t.buffer);
        if replay > MAX_REPLAY_BYTES {
            let value = format!("{} episodes of {} MiB in total", t.buffer, replay >> 20);
            return Err(Invalid::new("training.buffer", value, format!("at most {} MiB in total", MAX_REPLAY_BYTES >> 20)));
        }
        Ok(())
    }
}

impl TrainConfig {
    /// Checks that the networks fit fleets of any size.
    fn validate_vary(&self) -> Result<(), Invalid> {
        let t = &self.training;
        t.vary.validate(&self.environment).map_err(|e| e.with_prefix("training.vary"))?;
        if t.observation == ObservationKind::Flat {
            return Err(Invalid::new(
                "training.observation",
                "flat",
                "set, because training.vary draws fleets of different sizes",
            ));
        }
        if t.identity == Identity::Onehot {
            return Err(Invalid::new(
                "training.identity",
                "onehot",
                "another one, because training.vary draws fleets of different sizes",
            ));
        }
        if t.mixer == MixerKind::Qmix {
            return Err(Invalid::new(
                "training.mixer",
                "qmix",
                "another one, because training.vary draws fleets of different sizes",
            ));
        }
        if !t.batch.is_multiple_of(t.envs) || !t.buffer.is_multiple_of(t.envs) {
            let (field, value) =
                if t.batch.is_multiple_of(t.envs) { ("training.buffer", t.buffer) } else { ("training.batch", t.batch) };
            let expected =
                format!("a multiple of training.envs ({}), because episodes of one drawn environment stay together", t.envs);
            return Err(Invalid::new(field, value, expected));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_documented_presets_are_the_presets() {
        let text = include_str!("../../docs/algorithms.md");
        let fields = |preset| {
            let mut config = TrainConfig::resolve(Algorithm::Qedgix, preset, &Map::new(), &Map::new(), 1).unwrap();
            // The table states it in terms of K and N.
            config.environment.reward_scale = None;
            let (mut all, training) = (serde_json::to_value(&config.environment).unwrap(), config.training);
            let Value::Object(training) = serde_json::to_value(training).unwrap() else { unreachable!("a struct") };
            all.as_object_mut().unwrap().extend(training);
            all
        };
        let presets = [Preset::Paper, Preset::Authors, Preset::Practical].map(fields);
        let mut checked = 0;
        for line in text.lines() {
            let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
            let [field, values @ ..] = &cells[..] else { continue };
            let name = field.split('`').nth(1).unwrap_or("");
            if values.len() != 3 || name == "reward_scale" || presets[0].get(name).is_none() {
                continue;
            }
            for (preset, value) in presets.iter().zip(values) {
                let actual = preset[name].as_str().map_or_else(|| preset[name].to_string(), str::to_owned);
                assert_eq!(&actual, value, "{name}");
            }
            checked += 1;
        }
        assert_eq!(checked, 22, "rows of the table with the name of a field");
    }

    #[test]
    fn advice_needs_a_memory_and_its_margin_needs_advice() {
        let resolve = |preset, training: Value| {
            let Value::Object(training) = training else { unreachable!("an object") };
            TrainConfig::resolve(Algorithm::Qmix, preset, &Map::new(), &training, 1)
        };
        let field = |preset, training| resolve(preset, training).unwrap_err().field;
        assert_eq!(field(Preset::Practical, json!({"memory": "none", "advice": "sweep"})), "training.advice");
        assert_eq!(field(Preset::Paper, json!({"advice": "sweep"})), "training.advice");
        assert_eq!(field(Preset::Paper, json!({"advice_margin": 0.1})), "training.advice_margin");
        assert_eq!(field(Preset::Practical, json!({"advice": "none", "advice_margin": 0.1})), "training.advice_margin");
        assert_eq!(field(Preset::Practical, json!({"advice_margin": -0.1})), "training.advice_margin");
        // What a preset brings goes with what it needs.
        for without in [json!({"memory": "none"}), json!({"advice": "none"})] {
            let training = resolve(Preset::Practical, without).unwrap().training;
            assert_eq!((training.advice, training.advice_margin), (Advice::None, 0.0));
        }
    }

    #[test]
    fn steps_are_rounded_up_to_whole_iterations() {
        let mut config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        for (steps, total) in [(1, 640), (640, 640), (2000, 2560), (u64::MAX, u64::MAX)] {
            config.training.steps = steps;
            assert_eq!(config.total_steps(), total, "{steps}");
        }
        config.training.vary.slots = Some([10, 20]);
        config.training.steps = 2000;
        assert_eq!(config.total_steps(), 2000);
    }

    #[test]
    fn schedules_fall_linearly_and_stay_where_they_ended() {
        let t = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical).training;
        assert_eq!((t.epsilon_at(0), t.epsilon_at(100_000), t.epsilon_at(u64::MAX)), (1.0, 0.05, 0.05));
        assert!((t.epsilon_at(50_000) - 0.525).abs() < 1e-12);
        assert_eq!(t.learning_rate_at(0), 1e-3);
        assert!((t.learning_rate_at(u64::MAX) - 1e-4).abs() < 1e-12);
        let more = t.continued(t.steps, 5000);
        assert_eq!((more.steps, more.epsilon_anneal, more.learning_rate_at(5000)), (5000, 1, t.learning_rate_at(t.steps)));
        assert_eq!(more.epsilon_at(1), 0.05);
        assert_eq!(t.continued(40_000, 5000).epsilon_anneal, 60_000);
    }
}
