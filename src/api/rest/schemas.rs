//! Schemas of strings with a pattern, for `schema_with`, and types that serialize as such strings.

use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::json;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;
use utoipa::{PartialSchema, ToSchema};

use crate::api::config_schemas::schema;
use crate::jobs::metric_names;

/// Name of a policy or an alias.
macro_rules! name {
    () => {
        "[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}"
    };
}

/// Number of a version.
macro_rules! version {
    () => {
        "[1-9][0-9]{0,18}"
    };
}

fn string(pattern: &str) -> RefOr<Schema> {
    schema(json!({"type": "string", "pattern": pattern}))
}

/// NAME of a policy or an alias.
pub(super) fn name() -> RefOr<Schema> {
    string(concat!("^", name!(), "$"))
}

/// NAME, NAME@ALIAS or NAME:VERSION.
pub(super) fn policy_spec() -> RefOr<Schema> {
    string(concat!("^", name!(), "(@", name!(), "|:", version!(), ")?$"))
}

/// NAME, NAME@ALIAS, NAME:VERSION or an empty string.
pub(super) fn optional_policy_spec() -> RefOr<Schema> {
    string(concat!("^(", name!(), "(@", name!(), "|:", version!(), ")?)?$"))
}

/// NAME of a policy or an alias, or null.
pub(super) fn nullable_name() -> RefOr<Schema> {
    schema(json!({"type": ["string", "null"], "pattern": concat!("^", name!(), "$")}))
}

/// NAME, NAME@ALIAS, NAME:VERSION or null.
pub(super) fn nullable_policy_spec() -> RefOr<Schema> {
    schema(json!({
        "type": ["string", "null"], "pattern": concat!("^", name!(), "(@", name!(), "|:", version!(), ")?$")
    }))
}

/// Page token that contains a row id.
pub(super) fn number_token() -> RefOr<Schema> {
    string("^[0-9]{0,18}$")
}

/// Name of a job, or the beginning of a name before `*`.
pub(super) fn name_filter() -> RefOr<Schema> {
    string("^([A-Za-z0-9][A-Za-z0-9._-]{0,62}\\*?)?$")
}

/// Labels of jobs, separated by commas.
pub(super) fn label_filter() -> RefOr<Schema> {
    string("^([A-Za-z0-9][A-Za-z0-9._-]{0,62}(=[^,]*)?(,[A-Za-z0-9][A-Za-z0-9._-]{0,62}(=[^,]*)?)*)?$")
}

/// Order of a list of jobs.
pub(super) fn job_order() -> RefOr<Schema> {
    string(&format!("^(-?(created|name|(best|last):({})))?$", any_metric()))
}

/// Names of metrics, separated by commas.
pub(super) fn metric_names() -> RefOr<Schema> {
    let name = any_metric();
    string(&format!("^(({name})(,({name})){{0,15}})?$"))
}

/// Name of a metric of training jobs.
pub(super) fn metric_name() -> RefOr<Schema> {
    schema(json!({"type": "string", "enum": metric_names::all().collect::<Vec<_>>()}))
}

/// The names of all metrics of training jobs as alternatives of a pattern; none has a character with another meaning there.
fn any_metric() -> String {
    metric_names::all().collect::<Vec<_>>().join("|")
}

/// Page token of a list of jobs: a row id, after the name or value by which the list is sorted.
pub(super) fn job_token() -> RefOr<Schema> {
    string("^(([A-Za-z0-9._-]{0,63}~)?[0-9]{1,18})?$")
}

/// Page token that contains the name and step of a metric.
pub(super) fn metric_token() -> RefOr<Schema> {
    string("^([A-Za-z0-9_/.-]{1,63}@[0-9]{1,18})?$")
}

/// Bytes as the body of a request or a response.
pub(super) struct Binary;

impl PartialSchema for Binary {
    fn schema() -> RefOr<Schema> {
        schema(json!({"type": "string", "format": "binary"}))
    }
}

impl ToSchema for Binary {}

/// A duration in seconds with the suffix `s`, as in the JSON form of protobuf: `0.000021000s`.
#[derive(Debug)]
pub(super) struct Seconds(pub(super) Duration);

impl Serialize for Seconds {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&format_args!("{}.{:09}s", self.0.as_secs(), self.0.subsec_nanos()))
    }
}

impl PartialSchema for Seconds {
    fn schema() -> RefOr<Schema> {
        string("^[0-9]+\\.[0-9]{9}s$")
    }
}

impl ToSchema for Seconds {}

/// Bytes in base64.
#[derive(Debug)]
pub(super) struct Base64(pub(super) Bytes);

impl<'de> Deserialize<'de> for Base64 {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let bytes = BASE64_STANDARD.decode(text).map_err(|e| D::Error::custom(format!("not base64: {e}")))?;
        Ok(Self(bytes.into()))
    }
}

impl Serialize for Base64 {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&BASE64_STANDARD.encode(&self.0))
    }
}

impl PartialSchema for Base64 {
    fn schema() -> RefOr<Schema> {
        string("^([A-Za-z0-9+/]{4})*([A-Za-z0-9+/][AQgw]==|[A-Za-z0-9+/]{2}[AEIMQUYcgkosw048]=)?$")
    }
}

impl ToSchema for Base64 {}
