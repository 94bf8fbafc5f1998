//! Policies as models: how they are named, what they take and give, which there are.

use super::{STATE, outputs};
use crate::api::convert::tensors::{Datatype, Dimension, INPUTS, TensorShape};
use crate::invalid::Invalid;
use crate::policy::RequiredInput;
use crate::service::policies::{self, IndexEntry};
use crate::service::{App, Error};
use crate::serving::{Kind, PolicySpec, Which};

/// A model as metadata and configuration show it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// As it was asked for.
    pub name: String,
    /// Versions of that name.
    pub versions: Vec<String>,
    /// What it takes: a scene or a graph.
    pub inputs: Vec<TensorShape>,
    /// What it gives.
    pub outputs: Vec<TensorShape>,
}

/// The policy that a model's name and version mean.
///
/// # Errors
/// Neither is one, or they contradict each other.
pub(super) fn spec(name: &str, version: &str) -> Result<PolicySpec, Invalid> {
    let mut spec: PolicySpec = name.parse().map_err(|e: Invalid| Invalid { field: "model_name".into(), ..e })?;
    if version.is_empty() {
        return Ok(spec);
    }
    let wrong = |expected: String| Invalid::new("model_version", format!("{version:?}"), expected);
    let digits = version.bytes().all(|b| b.is_ascii_digit());
    let number = version.parse().ok().filter(|&number: &u64| digits && number > 0);
    let number = number.ok_or_else(|| wrong("a whole number from 1, or nothing for the newest".into()))?;
    match spec.which {
        Which::Newest => spec.which = Which::Version(number),
        Which::Version(named) if named == number => {}
        Which::Version(_) | Which::Alias(_) => return Err(wrong(format!("nothing: model_name says which, {spec}"))),
    }
    Ok(spec)
}

/// Tells of policies as of models.
pub(super) fn in_words_of_models(spec: &PolicySpec, error: Error) -> Error {
    match error {
        Error::NotFound { what: "policy", id } => Error::NotFound { what: "model", id },
        Error::Precondition { code: "policy_unloaded", .. } => not_loaded(spec),
        Error::Invalid(e) if e.field == "policy" => Invalid { field: "model_name".into(), ..e }.into(),
        other => other,
    }
}

fn not_loaded(spec: &PolicySpec) -> Error {
    Error::NotFound { what: "loaded model", id: spec.to_string() }
}

/// Describes a model.
///
/// # Errors
/// There is none of this name and version, or it is not loaded.
pub fn describe(app: &App, name: &str, version: &str) -> Result<Model, Error> {
    let spec = spec(name, version)?;
    let described = policies::get(app, &spec).map_err(|error| in_words_of_models(&spec, error))?;
    if !described.loaded {
        return Err(not_loaded(&spec));
    }
    let policy = &described.about;
    let loaded = || described.versions.iter().filter(|(_, loaded)| *loaded).map(|(version, _)| *version).collect();
    let versions: Vec<u64> = if spec.which == Which::Newest { loaded() } else { vec![policy.reference.version] };
    let size = |size: Option<u32>| size.map_or(-1, i64::from);
    let (uavs, users) = (size(policy.uavs), size(policy.users));
    let needs = policy.needs;
    let input = |(name, datatype, dimensions): (&'static str, Datatype, &[Dimension])| {
        let of_graph = name == "uav_count" || dimensions.contains(&Dimension::Edges);
        let optional = match name {
            "user_aoi" => false,
            "uav_positions" => needs == RequiredInput::Detections,
            "user_positions" => needs != RequiredInput::FullScene,
            _ => true,
        };
        let shape = dimensions.iter().map(|dimension| match dimension {
            Dimension::One => 1,
            Dimension::Two => 2,
            Dimension::Uavs => uavs,
            Dimension::Users => users,
            Dimension::Edges => -1,
        });
        let input = TensorShape { name, datatype, shape: shape.collect(), optional };
        (needs != RequiredInput::FullScene || !of_graph).then_some(input)
    };
    let state = TensorShape { name: STATE, datatype: Datatype::Bytes, shape: vec![1], optional: true };
    let outputs = outputs::described(uavs, policy.headings as i64, policy.kind == Kind::Checkpoint);
    Ok(Model {
        name: name.to_owned(),
        versions: versions.iter().map(u64::to_string).collect(),
        inputs: INPUTS.into_iter().filter_map(input).chain([state]).collect(),
        outputs: outputs.collect(),
    })
}

/// Whether a model can be asked.
///
/// # Errors
/// Its name or version is none that a model can have.
pub fn is_ready(app: &App, name: &str, version: &str) -> Result<bool, Error> {
    let spec = spec(name, version)?;
    match policies::get(app, &spec) {
        Ok(described) => Ok(described.loaded),
        Err(Error::NotFound { .. } | Error::Precondition { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

/// All versions of all models, or those that can be asked.
///
/// # Errors
/// A repository other than the only one, which has no name.
pub fn index(app: &App, repository: &str, ready: bool) -> Result<Vec<IndexEntry>, Error> {
    check_repository(repository)?;
    Ok(policies::index(app).into_iter().filter(|entry| entry.ready || !ready).collect())
}

/// Lets a model be asked again, in all its versions.
///
/// # Errors
/// There is no such model, or parameters that would change it.
pub async fn load(app: &App, repository: &str, name: &str, parameters: &[&str]) -> Result<(), Error> {
    check_repository(repository)?;
    if let Some(parameter) = parameters.first() {
        let expected = "no parameters: policies are published, not configured or sent when they are loaded";
        return Err(Invalid::new("parameters", format!("{parameter:?}"), expected).into());
    }
    policies::load_policy(app, name).await.map_err(in_words_of_names)
}

/// Lets a model not be asked any more; sequences under way go on.
///
/// # Errors
/// There is no such model, or unknown parameters.
pub async fn unload(app: &App, repository: &str, name: &str, parameters: &[&str]) -> Result<(), Error> {
    check_repository(repository)?;
    if let Some(parameter) = parameters.iter().find(|name| **name != "unload_dependents") {
        return Err(Invalid::new("parameters", format!("{parameter:?}"), "unload_dependents or nothing").into());
    }
    policies::unload_policy(app, name).await.map_err(in_words_of_names)
}

/// How the index calls it.
pub fn state(ready: bool) -> &'static str {
    if ready { "READY" } else { "UNAVAILABLE" }
}

/// How a model's configuration calls a datatype.
pub fn config_type(datatype: Datatype) -> &'static str {
    match datatype {
        Datatype::Int32 => "TYPE_INT32",
        Datatype::Int64 => "TYPE_INT64",
        Datatype::Fp32 => "TYPE_FP32",
        Datatype::Fp64 => "TYPE_FP64",
        Datatype::Bytes => "TYPE_STRING",
    }
}

fn check_repository(name: &str) -> Result<(), Invalid> {
    if name.is_empty() { Ok(()) } else { Err(Invalid::new("repository_name", format!("{name:?}"), "nothing: there is one")) }
}

fn in_words_of_names(error: Error) -> Error {
    match error {
        Error::NotFound { what: "policy", id } => Error::NotFound { what: "model", id },
        other => other,
    }
}
