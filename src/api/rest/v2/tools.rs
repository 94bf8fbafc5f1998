//! What tools of the protocol ask for besides inference: statistics, settings of traces and logs, shared memory.

use std::sync::Arc;

use axum::extract::State;
use axum::http::StatusCode;
use axum::routing::{get, post};
use axum::{Json, Router};
use serde_json::{Map, Value, json};

use super::{ModelPath, Shared, parse_or_default};
use crate::api::oip::{self, LogSetting, TRACE_SETTINGS, shared_memory};
use crate::api::rest::extract::{Path, Raw};
use crate::invalid::Invalid;
use crate::service::policies::VersionStatistics;
use crate::service::{App, Error};
use crate::serving::{ComputeCounts, TimedCount};

/// The routes.
pub(super) fn router() -> Router<Arc<App>> {
    let mut router = Router::new()
        .route("/v2/models/stats", get(all_statistics))
        .route("/v2/models/{model}/stats", get(statistics))
        .route("/v2/models/{model}/versions/{version}/stats", get(statistics))
        .route("/v2/trace/setting", get(trace_settings).post(set_trace))
        .route("/v2/models/{model}/trace/setting", get(model_trace_settings).post(set_model_trace))
        .route("/v2/logging", get(log_settings).post(set_logs));
    for memory in ["systemsharedmemory", "cudasharedmemory"] {
        router = router
            .route(&format!("/v2/{memory}/status"), get(no_regions))
            .route(&format!("/v2/{memory}/region/{{name}}/status"), get(region))
            .route(&format!("/v2/{memory}/region/{{name}}/register"), post(register))
            .route(&format!("/v2/{memory}/unregister"), post(unregistered))
            .route(&format!("/v2/{memory}/region/{{name}}/unregister"), post(unregistered));
    }
    router
}

async fn all_statistics(State(app): Shared) -> Result<Json<Value>, Error> {
    Ok(Json(statistics_json(oip::statistics(&app, "", "")?)))
}

async fn statistics(State(app): Shared, Path(path): Path<ModelPath>) -> Result<Json<Value>, Error> {
    Ok(Json(statistics_json(oip::statistics(&app, &path.model, &path.version)?)))
}

fn statistics_json(all: Vec<VersionStatistics>) -> Value {
    let timed = |TimedCount { count, nanos }: TimedCount| json!({"count": count, "ns": nanos});
    let batch = |(size, counts): (&u32, &ComputeCounts)| {
        json!({
            "batch_size": size,
            "compute_input": timed(counts.input),
            "compute_infer": timed(counts.infer),
            "compute_output": timed(counts.output),
        })
    };
    let model = |VersionStatistics { name, version, last_inference, statistics }: VersionStatistics| {
        json!({
            "name": name,
            "version": version.to_string(),
            "last_inference": last_inference,
            "inference_count": statistics.inferences,
            "execution_count": statistics.executions,
            "inference_stats": {
                "success": timed(statistics.success),
                "fail": timed(statistics.failure),
                "queue": timed(statistics.queue),
                "compute_input": timed(statistics.compute.input),
                "compute_infer": timed(statistics.compute.infer),
                "compute_output": timed(statistics.compute.output),
                "cache_hit": timed(TimedCount::default()),
                "cache_miss": timed(TimedCount::default()),
            },
            "batch_stats": statistics.batches.iter().map(batch).collect::<Vec<_>>(),
        })
    };
    json!({"model_stats": all.into_iter().map(model).collect::<Vec<_>>()})
}

fn trace_json() -> Json<Value> {
    let levels = |name: &str, value: &str| if name == "trace_level" { json!([value]) } else { json!(value) };
    Json(TRACE_SETTINGS.iter().map(|&(name, value)| (name.to_owned(), levels(name, value))).collect::<Map<_, _>>().into())
}

async fn trace_settings() -> Json<Value> {
    trace_json()
}

async fn model_trace_settings(State(app): Shared, Path(path): Path<ModelPath>) -> Result<Json<Value>, Error> {
    oip::check_trace_settings(&app, &path.model, &[])?;
    Ok(trace_json())
}

async fn set_trace(State(app): Shared, Raw(body): Raw) -> Result<Json<Value>, Error> {
    oip::check_trace_settings(&app, "", &wanted_traces(&body)?)?;
    Ok(trace_json())
}

async fn set_model_trace(State(app): Shared, Path(path): Path<ModelPath>, Raw(body): Raw) -> Result<Json<Value>, Error> {
    oip::check_trace_settings(&app, &path.model, &wanted_traces(&body)?)?;
    Ok(trace_json())
}

/// The settings that a body wants, each with its values; `null` stands for the default.
fn wanted_traces(body: &[u8]) -> Result<Vec<(String, Vec<String>)>, Error> {
    let text = |value: &Value| match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    };
    let setting = |(name, value): (String, Value)| {
        let values = match &value {
            Value::Null => Some(Vec::new()),
            Value::Array(values) => values.iter().map(text).collect(),
            other => text(other).map(|value| vec![value]),
        };
        match values {
            Some(values) => Ok((name, values)),
            None => Err(Invalid::schema(format!("settings.{name}"), value, "a string, an array of strings, or null").into()),
        }
    };
    parse_or_default::<Map<String, Value>>(body)?.into_iter().map(setting).collect()
}

fn logs_json() -> Json<Value> {
    let value = |setting| match setting {
        LogSetting::Bool(value) => json!(value),
        LogSetting::Number(value) => json!(value),
        LogSetting::Text(value) => json!(value),
    };
    Json(oip::log_settings().into_iter().map(|(name, setting)| (name.to_owned(), value(setting))).collect::<Map<_, _>>().into())
}

async fn log_settings() -> Json<Value> {
    logs_json()
}

async fn set_logs(Raw(body): Raw) -> Result<Json<Value>, Error> {
    let setting = |(name, value): (String, Value)| {
        let wanted = match &value {
            Value::Null => Some(None),
            Value::Bool(value) => Some(Some(LogSetting::Bool(*value))),
            Value::String(value) => Some(Some(LogSetting::Text(value.clone()))),
            Value::Number(number) => {
                number.as_u64().and_then(|number| u32::try_from(number).ok()).map(|number| Some(LogSetting::Number(number)))
            }
            _ => None,
        };
        let Some(wanted) = wanted else {
            let expected = "true, false, a whole number, a string, or null";
            return Err(Error::from(Invalid::schema(format!("settings.{name}"), value, expected)));
        };
        Ok((name, wanted))
    };
    let wanted: Vec<_> = parse_or_default::<Map<String, Value>>(&body)?.into_iter().map(setting).collect::<Result<_, _>>()?;
    oip::check_log_settings(&wanted)?;
    Ok(logs_json())
}

async fn no_regions() -> Json<Value> {
    Json(json!([]))
}

async fn region(Path(name): Path<String>) -> Result<Json<Value>, Error> {
    shared_memory::status(&name)?;
    Ok(Json(json!([])))
}

async fn register(Path(name): Path<String>) -> Result<StatusCode, Error> {
    shared_memory::register(&name)?;
    Ok(StatusCode::OK)
}

/// No region is registered, so there is nothing to do.
async fn unregistered() -> StatusCode {
    StatusCode::OK
}
