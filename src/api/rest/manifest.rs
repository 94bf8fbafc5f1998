//! REST: the manifest of policies, which replicas follow.

use std::collections::BTreeMap;
use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::openapi::Draining;
use crate::service::{App, Error, policies};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(manifest))
}

/// All policies with checkpoints, by name.
#[derive(Serialize, ToSchema)]
struct Manifest {
    policies: BTreeMap<String, ManifestPolicy>,
}

/// A policy in a manifest.
#[derive(Serialize, ToSchema)]
struct ManifestPolicy {
    /// In order of numbers.
    versions: Vec<ManifestVersion>,
    /// Aliases and the versions that they point to.
    aliases: BTreeMap<String, u64>,
}

/// A version in a manifest.
#[derive(Serialize, ToSchema)]
struct ManifestVersion {
    #[schema(minimum = 1)]
    version: u64,
    /// SHA-256 of the checkpoint.
    #[schema(pattern = "^[0-9a-f]{64}$")]
    sha256: String,
    /// Whether requests for it are accepted.
    loaded: bool,
}

impl From<policies::Manifest> for Manifest {
    fn from(manifest: policies::Manifest) -> Self {
        let version = |v: policies::ManifestVersion| ManifestVersion { version: v.version, sha256: v.sha256, loaded: v.loaded };
        let policy = |(name, policy): (String, policies::ManifestPolicy)| {
            let versions = policy.versions.into_iter().map(version).collect();
            (name, ManifestPolicy { versions, aliases: policy.aliases })
        };
        Self { policies: manifest.policies.into_iter().map(policy).collect() }
    }
}

/// Get all versions by digest and all aliases
///
/// What `qedgix serve --follow` takes over. A request with `if-none-match` and the `etag` of an earlier answer gets 304 while nothing has
/// changed.
#[utoipa::path(
    get, path = "/v1/manifest", operation_id = "getManifest", tag = "policies",
    responses(
        (
            status = 200, description = "The manifest.", body = Manifest,
            headers(("etag", description = "A digest of the manifest."))
        ),
        (status = 304, description = "Nothing has changed."),
        Draining
    )
)]
async fn manifest(State(app): State<Arc<App>>, headers: HeaderMap) -> Result<Response, Error> {
    let manifest = policies::manifest(&app)?;
    let tag = format!("\"{}\"", manifest.digest());
    let known = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|tags| tags.to_str().ok());
    if known.flat_map(|tags| tags.split(',')).any(|known| known.trim() == tag) {
        return Ok((StatusCode::NOT_MODIFIED, [(header::ETAG, tag)]).into_response());
    }
    Ok(([(header::ETAG, tag)], Json(Manifest::from(manifest))).into_response())
}
