//! Policies as models: names, metadata, the repository index, loading and unloading.

use super::{STATE, outputs};
use crate::api::convert::tensors::{Datatype, Dimension, INPUTS, TensorShape};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::policy::RequiredInput;
use crate::service::policies::{self, IndexEntry};
use crate::service::{App, Error};
use crate::serving::{PolicyKind, PolicySpec, VersionSelector};

/// A model as metadata and configuration show it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// The name in the request.
    pub name: String,
    /// Versions of that name.
    pub versions: Vec<String>,
    /// Inputs: those of a scene or of a graph.
    pub inputs: Vec<TensorShape>,
    /// Outputs.
    pub outputs: Vec<TensorShape>,
}

/// The policy that the name and the version of a model select.
///
/// # Errors
/// [`Invalid`] if one does not parse or they select different versions.
pub(super) fn policy_spec(name: &str, version: &str) -> Result<PolicySpec, Invalid> {
    let mut spec: PolicySpec = name.parse().map_err(|e: Invalid| Invalid { field: "model_name".into(), ..e })?;
    if version.is_empty() {
        return Ok(spec);
    }
    let invalid = |expected: String| Invalid::new("model_version", format!("{version:?}"), expected);
    let digits = version.bytes().all(|b| b.is_ascii_digit());
    let number = version.parse().ok().filter(|&number: &u64| digits && number > 0);
    let number = number.ok_or_else(|| invalid("a whole number from 1, or no value for the newest".into()))?;
    match spec.version {
        VersionSelector::Newest => spec.version = VersionSelector::Version(number),
        VersionSelector::Version(named) if named == number => {}
        VersionSelector::Version(_) | VersionSelector::Alias(_) => {
            return Err(invalid(format!("no value, because model_name selects the version: {spec}")));
        }
    }
    Ok(spec)
}

/// The error of a policy as the error of a model.
pub(super) fn model_error(error: Error) -> Error {
    match error {
        Error::Invalid(e) if e.field == "policy" => Invalid { field: "model_name".into(), ..e }.into(),
        other => repository_error(other),
    }
}

fn unloaded(spec: &PolicySpec) -> Error {
    let message = format!("policy {spec} is unloaded; load it first");
    Error::Precondition { code: ErrorCode::PolicyUnloaded, message }
}

/// Describes a model.
///
/// # Errors
/// [`Error::NotFound`] if the model does not exist, `policy_unloaded` if it is not loaded.
pub async fn describe(app: &App, name: &str, version: &str) -> Result<Model, Error> {
    let spec = policy_spec(name, version)?;
    let described = policies::get(app, &spec).await.map_err(model_error)?;
    if !described.loaded {
        return Err(unloaded(&spec));
    }
    let policy = &described.info;
    let loaded = || described.versions.iter().filter(|(_, loaded)| *loaded).map(|(version, _)| *version).collect();
    let versions: Vec<u64> = if spec.version == VersionSelector::Newest { loaded() } else { vec![policy.reference.version] };
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
    let outputs = outputs::shapes(uavs, policy.actions as i64, policy.kind == PolicyKind::Checkpoint);
    Ok(Model {
        name: name.to_owned(),
        versions: versions.iter().map(u64::to_string).collect(),
        inputs: INPUTS.into_iter().filter_map(input).chain([state]).collect(),
        outputs: outputs.collect(),
    })
}

/// Whether a model is loaded.
///
/// # Errors
/// [`Error::Invalid`] if the name or the version does not parse.
pub fn is_ready(app: &App, name: &str, version: &str) -> Result<bool, Error> {
    let spec = policy_spec(name, version)?;
    match policies::is_loaded(app, &spec) {
        Ok(loaded) => Ok(loaded),
        Err(Error::NotFound { .. } | Error::Precondition { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

/// All versions of all models, or only the loaded ones (`ready`).
///
/// # Errors
/// [`Error::Invalid`] if `repository` is not empty: the only repository has no name.
pub fn index(app: &App, repository: &str, ready: bool) -> Result<Vec<IndexEntry>, Error> {
    check_repository(repository)?;
    Ok(policies::index(app).into_iter().filter(|entry| entry.loaded || !ready).collect())
}

/// Loads all versions of a model.
///
/// # Errors
/// [`Error::NotFound`] for an unknown model, [`Error::Invalid`] for parameters, none of which are supported.
pub async fn load(app: &App, repository: &str, name: &str, parameters: &[&str]) -> Result<(), Error> {
    check_repository(repository)?;
    if let Some(parameter) = parameters.first() {
        let expected = "no parameters, because loading does not configure a policy";
        return Err(Invalid::new("parameters", format!("{parameter:?}"), expected).into());
    }
    policies::load_policy(app, name).await.map_err(repository_error)
}

/// Unloads all versions of a model. Sequences that have started continue.
///
/// # Errors
/// [`Error::NotFound`] for an unknown model, [`Error::Invalid`] for unknown parameters.
pub async fn unload(app: &App, repository: &str, name: &str, parameters: &[&str]) -> Result<(), Error> {
    check_repository(repository)?;
    if let Some(parameter) = parameters.iter().find(|name| **name != "unload_dependents") {
        return Err(Invalid::new("parameters", format!("{parameter:?}"), "unload_dependents or no parameter").into());
    }
    policies::unload_policy(app, name).await.map_err(repository_error)
}

/// The state in the repository index.
pub fn state(ready: bool) -> &'static str {
    if ready { "READY" } else { "UNAVAILABLE" }
}

/// The datatype in a model configuration.
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
    if name.is_empty() {
        Ok(())
    } else {
        Err(Invalid::new("repository_name", format!("{name:?}"), "no value, because the only repository has no name"))
    }
}

/// The error of a policy that is not found as that of a model.
fn repository_error(error: Error) -> Error {
    match error {
        Error::NotFound { what: "policy", id, near } => Error::NotFound { what: "model", id, near },
        Error::NotFound { what: "policy version", id, near } => Error::NotFound { what: "model version", id, near },
        other => other,
    }
}
