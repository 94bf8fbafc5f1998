//! `/v2`: the Open Inference Protocol over HTTP. Tensors are JSON, or binary data after the JSON.

mod request;
mod response;
mod tools;
mod values;

use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::extract::{Inflated, Path, Raw};
use crate::api::compression::Encoding;
use crate::api::convert::tensors::TensorShape;
use crate::api::errors::Problem;
use crate::api::json::object;
use crate::api::json::parse;
use crate::api::oip;
use crate::service::keys::Caller;
use crate::service::{App, Error, act};

/// Header with the length of the JSON before the binary data, in requests and responses.
const HEADER_LENGTH: HeaderName = HeaderName::from_static("inference-header-content-length");
/// Bytes of a body that are decoded at the cost of 1.
const BYTES_PER_COST: usize = 32;

type Shared = State<Arc<App>>;

/// The routes.
pub fn router() -> Router<Arc<App>> {
    Router::new()
        .route("/v2", get(server))
        .route("/v2/health/live", get(live))
        .route("/v2/health/ready", get(ready))
        .route("/v2/models/{model}", get(metadata))
        .route("/v2/models/{model}/ready", get(model_ready))
        .route("/v2/models/{model}/config", get(config))
        .route("/v2/models/{model}/infer", post(infer))
        .route("/v2/models/{model}/versions/{version}", get(metadata))
        .route("/v2/models/{model}/versions/{version}/ready", get(model_ready))
        .route("/v2/models/{model}/versions/{version}/config", get(config))
        .route("/v2/models/{model}/versions/{version}/infer", post(infer))
        .route("/v2/repository/index", post(index))
        .route("/v2/repository/models/{model}/load", post(load))
        .route("/v2/repository/models/{model}/unload", post(unload))
        .merge(tools::router())
}

/// Whether a path belongs to `/v2`, known or not.
pub fn is_v2(path: &str) -> bool {
    path == "/v2" || path.starts_with("/v2/")
}

/// Converts a problem response to the error format of the protocol: `error` and `code`, and where known `field`, `value`,
/// `expected`, `required_scope` and `primary`. Keeps the status and the headers.
pub fn convert_problem(mut response: Response) -> Response {
    let Some(problem) = response.extensions_mut().remove::<Problem>() else { return response };
    let mut body = json!({"error": problem.detail, "code": problem.code});
    let required_scope = problem.required_scope.map(str::to_owned);
    let details = [
        ("field", problem.field),
        ("value", problem.value),
        ("expected", problem.expected),
        ("required_scope", required_scope),
        ("primary", problem.primary),
    ];
    for (name, value) in details {
        if let Some(value) = value {
            body[name] = value.into();
        }
    }
    let mut converted = (response.status(), Json(body)).into_response();
    let (headers, body_of) = (converted.headers_mut(), [axum::http::header::CONTENT_TYPE, axum::http::header::CONTENT_LENGTH]);
    headers.extend(response.headers().iter().filter(|(name, _)| !body_of.contains(name)).map(|(n, v)| (n.clone(), v.clone())));
    converted
}

/// Path parameters: a model and optionally its version.
#[derive(Debug, Deserialize)]
struct ModelPath {
    model: String,
    #[serde(default)]
    version: String,
}

async fn server() -> Json<Value> {
    Json(json!({"name": oip::NAME, "version": oip::VERSION, "extensions": oip::EXTENSIONS}))
}

async fn live() -> Json<Value> {
    Json(json!({"live": true}))
}

async fn ready(State(app): Shared) -> Result<Json<Value>, Error> {
    app.ready().await?;
    Ok(Json(json!({"ready": true})))
}

async fn model_ready(State(app): Shared, Path(path): Path<ModelPath>) -> Result<Json<Value>, Error> {
    if !oip::is_ready(&app, &path.model, &path.version)? {
        // Returns the error if the model does not exist or is not loaded.
        oip::describe(&app, &path.model, &path.version).await?;
    }
    Ok(Json(json!({"name": path.model, "ready": true})))
}

async fn metadata(State(app): Shared, Path(path): Path<ModelPath>) -> Result<Json<Value>, Error> {
    let model = oip::describe(&app, &path.model, &path.version).await?;
    let tensor = |t: &TensorShape| json!({"name": t.name, "datatype": t.datatype.name(), "shape": t.shape});
    Ok(Json(json!({
        "name": model.name,
        "versions": model.versions,
        "platform": oip::NAME,
        "inputs": model.inputs.iter().map(tensor).collect::<Vec<_>>(),
        "outputs": model.outputs.iter().map(tensor).collect::<Vec<_>>(),
    })))
}

async fn config(State(app): Shared, Path(path): Path<ModelPath>) -> Result<Json<Value>, Error> {
    let model = oip::describe(&app, &path.model, &path.version).await?;
    let output = |t: &TensorShape| json!({"name": t.name, "data_type": oip::config_type(t.datatype), "dims": t.shape});
    let input = |t: &TensorShape| {
        let mut input = output(t);
        input["optional"] = t.optional.into();
        input
    };
    let idle = u64::try_from(app.sessions.ttl().as_micros()).unwrap_or(u64::MAX);
    Ok(Json(json!({
        "name": model.name,
        "platform": oip::NAME,
        "backend": oip::NAME,
        "max_batch_size": 0,
        "input": model.inputs.iter().map(input).collect::<Vec<_>>(),
        "output": model.outputs.iter().map(output).collect::<Vec<_>>(),
        "sequence_batching": {"max_sequence_idle_microseconds": idle},
        "model_transaction_policy": {"decoupled": false},
    })))
}

async fn infer(
    State(app): Shared,
    caller: Caller,
    Path(path): Path<ModelPath>,
    headers: HeaderMap,
    Inflated(body): Inflated,
) -> Result<Response, Error> {
    let encoding = Encoding::accepted(&headers, header::ACCEPT_ENCODING.as_str());
    let ModelPath { model, version } = path;
    let cost = body.len() / BYTES_PER_COST;
    let decode = move || request::decode(&headers, body, model, version);
    let (request, binary) = act::decode(&app, &caller, cost, None, decode).await??;
    let response = response::encode(oip::infer(&app, &caller, request, None).await?, &binary);
    response::compressed(response, encoding).await
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct IndexRequest {
    #[serde(default)]
    ready: bool,
}

async fn index(State(app): Shared, Raw(body): Raw) -> Result<Json<Value>, Error> {
    let IndexRequest { ready } = parse_or_default(&body)?;
    let entry = |entry: crate::service::policies::IndexEntry| {
        json!({
            "name": entry.name,
            "version": entry.version.to_string(),
            "state": oip::state(entry.loaded),
            "reason": entry.reason,
        })
    };
    Ok(Json(oip::index(&app, "", ready)?.into_iter().map(entry).collect()))
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct RepositoryRequest {
    #[serde(default, deserialize_with = "object")]
    parameters: Map<String, Value>,
}

impl RepositoryRequest {
    fn parameter_names(&self) -> Vec<&str> {
        self.parameters.keys().map(String::as_str).collect()
    }
}

async fn load(State(app): Shared, Path(model): Path<String>, Raw(body): Raw) -> Result<StatusCode, Error> {
    let request: RepositoryRequest = parse_or_default(&body)?;
    oip::load(&app, "", &model, &request.parameter_names()).await?;
    Ok(StatusCode::OK)
}

async fn unload(State(app): Shared, Path(model): Path<String>, Raw(body): Raw) -> Result<StatusCode, Error> {
    let request: RepositoryRequest = parse_or_default(&body)?;
    oip::unload(&app, "", &model, &request.parameter_names()).await?;
    Ok(StatusCode::OK)
}

/// Parses a body that may be empty.
fn parse_or_default<T: Default + serde::de::DeserializeOwned>(body: &[u8]) -> Result<T, Error> {
    if body.is_empty() { Ok(T::default()) } else { parse(body) }
}
