//! Warm starts: whether a training run can begin with the parameters of a checkpoint, and which it takes over.

use serde_json::{Value, json};

use super::{Checkpoint, parameter_layout};
use crate::invalid::Invalid;
use crate::nn::Parameter;
use crate::policy::{Agent, AgentConfig, Gnn};
use crate::train_config::TrainConfig;

/// The parameters that a run begins with.
#[derive(Clone, Debug, PartialEq)]
pub struct InitialParameters {
    /// Flat, in the order of [`parameter_layout`].
    pub parameters: Vec<f32>,
    /// Whether those of the mixer are the checkpoint's, too.
    pub mixer: bool,
}

impl Checkpoint {
    /// Checks that the agents of a run of `config` can begin with these parameters: their architecture is the same.
    ///
    /// # Errors
    /// [`Invalid`] with the first field of `config` that differs, and the value that fits.
    pub fn check_architecture(&self, config: &TrainConfig) -> Result<(), Invalid> {
        let (ours, theirs) = (config.agent(), self.config.agent());
        let fits = |value: &Value| format!("{value}, as in the initial weights");
        if ours.gnn != theirs.gnn {
            return Err(Invalid::new("algorithm", json!(config.algorithm), fits(&json!(self.config.algorithm))));
        }
        let (Value::Object(own), other) = (json!(ours), json!(theirs)) else { unreachable!("a struct") };
        for (field, value) in own.iter().filter(|(field, _)| matters(field, &ours)) {
            if *value != other[field] {
                return Err(Invalid::new(format!("training.{field}"), value, fits(&other[field])));
            }
        }
        if agent_shapes(config) == agent_shapes(&self.config) {
            return Ok(());
        }
        let (own, mut known) = (&config.environment, self.config.clone());
        let env = &self.config.environment;
        known.environment.hover = own.hover;
        if agent_shapes(&known) != agent_shapes(&self.config) {
            return Err(Invalid::new("environment.hover", own.hover, fits(&json!(env.hover))));
        }
        known.environment.uavs = own.uavs;
        if agent_shapes(&known) != agent_shapes(&self.config) {
            return Err(Invalid::new("environment.uavs", own.uavs, fits(&json!(env.uavs))));
        }
        Err(Invalid::new("environment.users", own.users, fits(&json!(env.users))))
    }

    /// The parameters of a run of `config` that begins with this checkpoint, where `drawn` are those that it would begin with
    /// otherwise. The parameters of the mixer are taken over if the checkpoint has the same mixer.
    ///
    /// # Errors
    /// As [`Checkpoint::check_architecture`].
    pub fn initial_parameters(&self, config: &TrainConfig, drawn: &[f32]) -> Result<InitialParameters, Invalid> {
        self.check_architecture(config)?;
        let (ours, theirs) = (parameter_layout(config), parameter_layout(&self.config));
        let shapes = |p: &Parameter| (p.name.clone(), p.shape.clone());
        // The agents come first in both, with the same shapes.
        let mixer = self.parameters.len() == theirs.len()
            && config.training.mixer == self.config.training.mixer
            && ours.parameters().iter().map(shapes).eq(theirs.parameters().iter().map(shapes));
        let agents = agent_len(config);
        let taken = if mixer { ours.len() } else { agents };
        let mut parameters = drawn.to_vec();
        parameters[..taken].copy_from_slice(&self.parameters[..taken]);
        Ok(InitialParameters { parameters, mixer: taken > agents })
    }
}

/// Whether a field of the architecture has an effect on the agents.
fn matters(field: &str, agent: &AgentConfig) -> bool {
    match field {
        "gnn" => false,
        "layers" | "self_loops" => agent.gnn != Gnn::None,
        "aggregation" => agent.gnn == Gnn::EdgeConv,
        _ => true,
    }
}

fn agent_shapes(config: &TrainConfig) -> Vec<(String, Vec<usize>)> {
    let agent = Agent::new(config.agent(), config.dims());
    agent.layout().parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect()
}

fn agent_len(config: &TrainConfig) -> usize {
    Agent::new(config.agent(), config.dims()).layout().len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::mixer::MixerKind;
    use crate::policy::{Identity, Memory, ObservationKind};
    use crate::train_config::{Algorithm, Preset};

    fn checkpoint(config: &TrainConfig) -> Checkpoint {
        let len = parameter_layout(config).len();
        Checkpoint::new(config.clone(), 400, None, (0..len).map(|i| i as f32).collect()).unwrap()
    }

    #[test]
    fn a_field_that_differs_is_named() {
        let mut known = TrainConfig::preset(Algorithm::Qedgix, Preset::Paper);
        known.environment.reward_scale = Some(1.0);
        let weights = checkpoint(&known);
        let change = |change: &dyn Fn(&mut TrainConfig)| {
            let mut config = known.clone();
            change(&mut config);
            weights.check_architecture(&config).map_err(|e| e.field)
        };
        let refused: [(&str, &dyn Fn(&mut TrainConfig)); 9] = [
            ("algorithm", &|c| c.algorithm = Algorithm::Rgcn),
            ("training.layers", &|c| c.training.layers = 3),
            ("training.aggregation", &|c| c.training.aggregation = crate::policy::Aggregation::Mean),
            ("training.observation", &|c| c.training.observation = ObservationKind::Set),
            ("training.identity", &|c| c.training.identity = Identity::Phase),
            ("training.memory", &|c| c.training.memory = Memory::Own),
            ("environment.hover", &|c| c.environment.hover = true),
            ("environment.uavs", &|c| c.environment.uavs = 4),
            ("environment.users", &|c| c.environment.users = 6),
        ];
        for (field, differs) in refused {
            assert_eq!(change(differs), Err(field.to_owned()));
        }
        // What the agents do not depend on may differ.
        change(&|c| {
            c.training.learning_rate = 1e-5;
            c.training.mixer = MixerKind::Qmix;
            c.environment.slots = 30;
            c.seed = 9;
        })
        .unwrap();
    }

    #[test]
    fn the_mixer_is_taken_over_if_it_is_the_same() {
        let known = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        let weights = checkpoint(&known);
        let drawn = vec![-1.0; parameter_layout(&known).len()];
        let initial = weights.initial_parameters(&known, &drawn).unwrap();
        assert!(initial.mixer && initial.parameters == weights.parameters());
        let mut vdn = known.clone();
        (vdn.algorithm, vdn.training.mixer) = (Algorithm::Vdn, MixerKind::Vdn);
        let initial = weights.initial_parameters(&vdn, &vec![-1.0; parameter_layout(&vdn).len()]).unwrap();
        assert!(!initial.mixer);
        let mut other = known.clone();
        other.training.mixer = MixerKind::Qmix;
        let initial = weights.initial_parameters(&other, &vec![-1.0; parameter_layout(&other).len()]).unwrap();
        let agents = agent_len(&known);
        assert!(!initial.mixer && initial.parameters[..agents] == weights.parameters()[..agents]);
        assert!(initial.parameters.len() > agents && initial.parameters[agents..].iter().all(|x| *x == -1.0));
    }
}
