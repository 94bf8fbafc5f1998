//! Checkpoints: the parameters and the configuration of a training run as a safetensors file.
//!
//! Metadata: `format`, `version`, `config` (the resolved [`TrainConfig`] as JSON), `step`, and `metrics` if the parameters were
//! evaluated. Tensors have the names and shapes of the golden files (docs/model.md, "Golden files"); `agent.*` is required to run
//! the policy, `mixer.*` is optional. The same content gives the same bytes, so the digest identifies it. Reading checks
//! everything: it returns a usable checkpoint or an [`Error`].

mod error;
mod file;
mod format;
mod warm_start;

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

pub use error::Error;
pub use file::Tensor;
pub use format::{FORMAT, MAX_MAGNITUDE, VERSION};
pub use warm_start::InitialParameters;

use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::nn::ParameterLayout;
use crate::policy::mixer::Mixer;
use crate::policy::{Agent, LearnedPolicy};
use crate::train_config::TrainConfig;

/// Parameters and the configuration that they were trained with.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    config: TrainConfig,
    env_steps: u64,
    metrics: Option<EpisodeMetrics>,
    /// Flat, in the order of [`parameter_layout`]: `agent.*`, and `mixer.*` if present.
    parameters: Vec<f32>,
}

/// The parameters of a configuration, `agent.*` then `mixer.*`: the order of the flat vector of [`Checkpoint::parameters`].
pub fn parameter_layout(config: &TrainConfig) -> ParameterLayout {
    let dims = config.dims();
    let mut layout = Agent::new(config.agent(), dims).layout().clone();
    Mixer::new(config.training.mixer, &dims, &mut layout);
    layout
}

impl Checkpoint {
    /// A checkpoint of `parameters` (flat, as [`parameter_layout`] orders them) after `env_steps` environment steps.
    ///
    /// # Errors
    /// [`Error::Config`] if the configuration is invalid or has another number of parameters; [`Error::Value`] if a parameter is
    /// not finite or too large.
    pub fn new(
        config: TrainConfig,
        env_steps: u64,
        metrics: Option<EpisodeMetrics>,
        parameters: Vec<f32>,
    ) -> Result<Self, Error> {
        config.validate()?;
        let layout = parameter_layout(&config);
        if parameters.len() != layout.len() {
            return Err(
                Invalid::new("parameters", format!("{} numbers", parameters.len()), format!("{} numbers", layout.len())).into()
            );
        }
        for p in layout.parameters() {
            let values = &parameters[p.range.clone()];
            if let Some(index) = values.iter().position(|x| x.is_nan() || x.abs() > MAX_MAGNITUDE) {
                return Err(Error::Value { name: p.name.clone(), index, found: values[index] });
            }
        }
        Ok(Self { config, env_steps, metrics, parameters })
    }

    /// The resolved configuration of the run.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// Environment steps of the training run when the checkpoint was taken.
    pub fn env_steps(&self) -> u64 {
        self.env_steps
    }

    /// Metrics on the validation layouts, if the parameters were evaluated.
    pub fn metrics(&self) -> Option<&EpisodeMetrics> {
        self.metrics.as_ref()
    }

    /// The flat vector in the order of [`parameter_layout`]. Without `mixer.*` in the file, it ends after `agent.*`.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// The policy with these parameters.
    ///
    /// # Panics
    /// Never: the parameters were checked when the checkpoint was created or read.
    pub fn policy(&self) -> LearnedPolicy {
        let len = Agent::new(self.config.agent(), self.config.dims()).layout().len();
        self.config.policy(self.parameters[..len].to_vec()).expect("checked when the checkpoint was created or read")
    }

    /// The bytes of the file.
    ///
    /// # Panics
    /// Never: the configuration can always be written as JSON.
    pub fn to_bytes(&self) -> Vec<u8> {
        let json = |value: serde_json::Result<String>| value.expect("plain data with string keys");
        let mut metadata = BTreeMap::from([
            ("format", FORMAT.to_owned()),
            ("version", VERSION.to_owned()),
            ("config", json(serde_json::to_string(&self.config))),
            ("step", self.env_steps.to_string()),
        ]);
        if let Some(metrics) = &self.metrics {
            metadata.insert("metrics", json(serde_json::to_string(metrics)));
        }
        let layout = parameter_layout(&self.config);
        let held = layout.parameters().iter().filter(|p| p.range.end <= self.parameters.len());
        let tensors: Vec<Tensor> = held
            .map(|p| Tensor { name: p.name.clone(), shape: p.shape.clone(), values: self.parameters[p.range.clone()].to_vec() })
            .collect();
        file::write(&metadata, &tensors)
    }

    /// Reads a file from an untrusted source.
    ///
    /// # Errors
    /// [`Error`] if the bytes are not a usable checkpoint.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Error> {
        let (metadata, tensors) = file::read(bytes)?;
        let entry = |field: &str| metadata.get(field).cloned();
        if entry("format").as_deref() != Some(FORMAT) {
            return Err(Error::Format { found: entry("format") });
        }
        if entry("version").as_deref() != Some(VERSION) {
            return Err(Error::Version { found: entry("version") });
        }
        let missing = |field| Error::Metadata { field, reason: "missing".into() };
        let unreadable = |field| move |e: serde_json::Error| Error::Metadata { field, reason: e.to_string() };
        let config: TrainConfig =
            serde_json::from_str(&entry("config").ok_or_else(|| missing("config"))?).map_err(unreadable("config"))?;
        config.validate()?;
        let step = entry("step").ok_or_else(|| missing("step"))?;
        let env_steps =
            step.parse().map_err(|_| Error::Metadata { field: "step", reason: format!("{step:?} is not a count") })?;
        let metrics = entry("metrics").map(|m| serde_json::from_str(&m).map_err(unreadable("metrics"))).transpose()?;
        let parameters = flatten(&config, tensors)?;
        Ok(Self { config, env_steps, metrics, parameters })
    }
}

/// The flat vector of the tensors of a file: all of `agent.*`, and all or none of `mixer.*`.
fn flatten(config: &TrainConfig, tensors: Vec<Tensor>) -> Result<Vec<f32>, Error> {
    let mut named: BTreeMap<String, Tensor> = tensors.into_iter().map(|t| (t.name.clone(), t)).collect();
    let layout = parameter_layout(config);
    let trainable = named.keys().any(|name| name.starts_with("mixer."));
    let mut flat = Vec::new();
    for p in layout.parameters().iter().filter(|p| trainable || p.name.starts_with("agent.")) {
        let Some(t) = named.remove(&p.name) else { return Err(Error::Missing { name: p.name.clone() }) };
        if t.shape != p.shape {
            return Err(Error::Shape { name: t.name, found: t.shape, expected: p.shape.clone() });
        }
        flat.extend(t.values);
    }
    match named.into_keys().next() {
        Some(name) => Err(Error::Unexpected { name }),
        None => Ok(flat),
    }
}

/// The digest of a file: SHA-256 of its bytes, in hexadecimal.
pub fn digest(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}
