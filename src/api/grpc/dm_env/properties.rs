//! The extension `properties` of dm_env_rpc: what a world is made of, and how its last episode went. Nothing can be written.

use prost::Message;

use super::tensors::{double, integer, spec, text};
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::Error;
use crate::wire::dm::dm_env_rpc::v1 as wire;
use crate::wire::dm::dm_env_rpc::v1::extensions::properties as ext;
use ext::property_request::Payload as Request;
use ext::property_response::Payload as Response;
use wire::DataType;

/// Name of the messages in an `Any`.
const REQUEST: &str = "dm_env_rpc.v1.extensions.properties.PropertyRequest";
const RESPONSE: &str = "type.googleapis.com/dm_env_rpc.v1.extensions.properties.PropertyResponse";

/// The world that is joined: its configuration, and metrics and seed of its last episode that ended.
pub(super) type World<'a> = (&'a EnvConfig, Option<&'a (EpisodeMetrics, u64)>);

const PROPERTIES: [(&str, DataType, &str); 7] = [
    ("configuration", DataType::String, "The configuration of the world in JSON."),
    ("mean_aoi", DataType::Double, "Mean AoI of the last episode that ended, in slots."),
    ("peak_aoi", DataType::Double, "Largest AoI of that episode, in slots."),
    ("p95_aoi", DataType::Double, "95th percentile of AoI over users and slots of that episode."),
    ("coverage", DataType::Double, "Share of the users whose data was collected in that episode."),
    ("fairness", DataType::Double, "Jain's fairness index of the mean AoI per user of that episode."),
    ("seed", DataType::Int64, "Seed of that episode."),
];

/// Answers a request of the extension.
///
/// # Errors
/// [`Error::Invalid`] for other extensions, and for properties that do not exist or cannot be written; `wrong_state` where no world is
/// joined, or no episode has ended.
pub(super) fn answer(request: &prost_types::Any, world: Option<World<'_>>) -> Result<prost_types::Any, Error> {
    let wrong = |value: &str| Invalid::new("extension", value, REQUEST);
    if request.type_url.rsplit('/').next() != Some(REQUEST) {
        return Err(wrong(&request.type_url).into());
    }
    let request = ext::PropertyRequest::decode(&*request.value).map_err(|_| wrong("bytes that are not this message"))?;
    let payload = match request.payload {
        Some(Request::ReadProperty(request)) => {
            Response::ReadProperty(ext::ReadPropertyResponse { value: Some(read(&request.key, world)?) })
        }
        Some(Request::ListProperty(request)) if request.key.is_empty() => {
            Response::ListProperty(ext::ListPropertyResponse { values: PROPERTIES.map(described).to_vec() })
        }
        Some(Request::ListProperty(request)) => return Err(unknown(&request.key).into()),
        Some(Request::WriteProperty(request)) => {
            return Err(
                Invalid::new("write_property.key", format!("{:?}", request.key), "no property: none can be written").into()
            );
        }
        None => return Err(Invalid::missing("extension.payload", "a request").into()),
    };
    let value = ext::PropertyResponse { payload: Some(payload) }.encode_to_vec();
    Ok(prost_types::Any { type_url: RESPONSE.to_owned(), value })
}

fn wrong_state(message: &str) -> Error {
    Error::Precondition { code: ErrorCode::WrongState, message: message.to_owned() }
}

fn described((name, dtype, description): (&str, DataType, &str)) -> ext::PropertySpec {
    ext::PropertySpec {
        spec: Some(spec(name, dtype, &[])),
        is_readable: true,
        is_writable: false,
        is_listable: false,
        description: description.to_owned(),
    }
}

fn unknown(key: &str) -> Invalid {
    let known: Vec<&str> = PROPERTIES.iter().map(|(name, ..)| *name).collect();
    Invalid::new("key", format!("{key:?}"), format!("one of {}", known.join(", ")))
}

fn read(key: &str, world: Option<World<'_>>) -> Result<wire::Tensor, Error> {
    if !PROPERTIES.iter().any(|(name, ..)| *name == key) {
        return Err(unknown(key).into());
    }
    let Some((config, finished)) = world else { return Err(wrong_state("this stream has joined no world")) };
    if key == "configuration" {
        return Ok(text(serde_json::to_string(config).map_err(Error::internal)?));
    }
    let Some((metrics, seed)) = finished else {
        return Err(wrong_state("no episode has ended since the world was joined"));
    };
    let EpisodeMetrics { mean_aoi, peak_aoi, p95_aoi, coverage, fairness } = *metrics;
    Ok(match key {
        "mean_aoi" => double(mean_aoi),
        "peak_aoi" => double(peak_aoi),
        "p95_aoi" => double(p95_aoi),
        "coverage" => double(coverage),
        "fairness" => double(fairness),
        _ => integer(*seed as i64),
    })
}
