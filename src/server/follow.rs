//! The task of a replica: it takes policies, versions and aliases from its primary, by digest, and keeps what it has while the primary
//! is away.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use reqwest::header::{AUTHORIZATION, ETAG, HeaderValue, IF_NONE_MATCH};
use reqwest::redirect::Policy;
use reqwest::{Client, Response, StatusCode};
use serde::Deserialize;

use crate::causes;
use crate::config::FollowConfig;
use crate::service::policies::{self, Manifest, MissingVersion};
use crate::service::{App, Error as ServiceError};
use crate::serving::PolicyRef;

/// Time between two questions to the primary: while it answers, and the longest while it does not.
const INTERVAL: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(8)];
/// Time after which a version that could not be taken over is tried again.
const RETRY_VERSION: Duration = Duration::from_secs(60);
/// Time for a connection to be made, and for each part of an answer to arrive.
const TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum size of a manifest: some hundred thousand versions.
const MAX_MANIFEST: usize = 64 << 20;
/// Maximum size of a checkpoint, as large as workers may upload.
const MAX_CHECKPOINT: usize = 256 << 20;
/// Maximum size of a description.
const MAX_DESCRIPTION: usize = 4 << 20;

/// Why the state of the primary, or one version, cannot be taken over.
#[derive(Debug, thiserror::Error)]
enum FollowError {
    /// The primary does not answer.
    #[error("{}", causes::text(.0))]
    Request(#[from] reqwest::Error),
    /// The primary refuses the request.
    #[error("{path}: {status}; {hint}")]
    Refused { path: String, status: StatusCode, hint: &'static str },
    /// The answer is too large or malformed.
    #[error("{path}: {reason}")]
    Malformed { path: String, reason: String },
    /// The answer cannot be taken over.
    #[error("{}", .0.reason())]
    Service(#[from] ServiceError),
}

impl FollowError {
    /// Whether the trouble is that of one version, so that others can be taken over.
    fn is_of_version(&self) -> bool {
        match self {
            Self::Refused { status, .. } => {
                matches!(*status, StatusCode::NOT_FOUND | StatusCode::CONFLICT | StatusCode::INTERNAL_SERVER_ERROR)
            }
            Self::Malformed { .. } => true,
            Self::Service(error) => matches!(error, ServiceError::Invalid(_) | ServiceError::Precondition { .. }),
            Self::Request(_) => false,
        }
    }
}

/// What is read of the description of a version.
#[derive(Deserialize)]
struct Description {
    created_at: Timestamp,
}

/// Follows a primary.
pub(super) struct Follower {
    client: Client,
    url: String,
    authorization: Option<HeaderValue>,
    /// The `etag` of the manifest that this server is in step with.
    in_step_with: Option<HeaderValue>,
    /// Versions that could not be taken over, and the monotonic time of the next try.
    refused: HashMap<(String, u64, [u8; 32]), Duration>,
}

impl Follower {
    /// # Errors
    /// The client cannot be made.
    pub(super) fn new(config: &FollowConfig) -> Result<Self, reqwest::Error> {
        let client = Client::builder()
            .tls_backend_preconfigured(config.tls.clone())
            .redirect(Policy::none())
            .no_proxy()
            .connect_timeout(TIMEOUT)
            .read_timeout(TIMEOUT)
            .user_agent(concat!("qedgix/", env!("CARGO_PKG_VERSION")))
            .build()?;
        let (url, authorization) = (config.url.clone(), config.authorization.clone());
        Ok(Self { client, url, authorization, in_step_with: None, refused: HashMap::new() })
    }

    /// Follows until it is aborted.
    pub(super) async fn run(mut self, app: Arc<App>) {
        let [interval, longest] = INTERVAL;
        let mut delay = interval;
        // Why the last question failed. The same reason is logged once.
        let mut trouble = None;
        loop {
            match self.follow_once(&app).await {
                Ok(()) => {
                    if trouble.take().is_some() {
                        tracing::info!(primary = self.url, "the primary answers again");
                    }
                    delay = interval;
                }
                Err(error) => {
                    metrics::counter!("qedgix_replica_failures_total").increment(1);
                    let reason = error.to_string();
                    if trouble.as_ref() != Some(&reason) {
                        tracing::warn!(
                            primary = self.url,
                            reason,
                            "cannot follow the primary; keeping what is here, trying again"
                        );
                    }
                    trouble = Some(reason);
                    delay = (delay * 2).min(longest);
                }
            }
            app.clock.sleep_until(app.clock.monotonic().saturating_add(delay)).await;
        }
    }

    /// Brings this server to the state of the primary, once.
    async fn follow_once(&mut self, app: &App) -> Result<(), FollowError> {
        let path = "/v1/manifest";
        let answer = self.get(path, self.in_step_with.clone()).await?;
        if answer.status() != StatusCode::NOT_MODIFIED {
            let tag = answer.headers().get(ETAG).cloned();
            let manifest: Manifest = json(path, &body(path, answer, MAX_MANIFEST).await?)?;
            self.take_missing(app, &manifest).await?;
            let aligned = policies::align(app, &manifest).await?;
            self.in_step_with = tag.filter(|_| aligned && self.refused.is_empty());
        }
        if let Some(replica) = &app.replica {
            replica.confirm(self.refused.len(), &app.store, &app.clock).await.map_err(ServiceError::from)?;
        }
        Ok(())
    }

    /// Takes over all versions that this server does not have. One that cannot be taken over does not keep the others from it.
    async fn take_missing(&mut self, app: &App, manifest: &Manifest) -> Result<(), FollowError> {
        let missing = policies::missing(app, manifest).map_err(ServiceError::from)?;
        let key = |version: &MissingVersion| {
            let PolicyRef { name, version, digest } = &version.reference;
            (name.clone(), *version, *digest)
        };
        let before = std::mem::take(&mut self.refused);
        self.refused = missing.iter().map(key).filter_map(|key| before.get(&key).map(|next| (key.clone(), *next))).collect();
        for version in missing {
            let key = key(&version);
            let (now, next) = (app.clock.monotonic(), self.refused.get(&key));
            if next.is_some_and(|next| now < *next) {
                continue;
            }
            let first = next.is_none();
            match self.take(app, &version).await {
                Ok(()) => drop(self.refused.remove(&key)),
                Err(error) if error.is_of_version() => {
                    let (policy, reason) = (&version.reference, error.to_string());
                    if first {
                        tracing::error!(%policy, reason, "a version of the primary cannot be taken over; trying again");
                    }
                    self.refused.insert(key, now.saturating_add(RETRY_VERSION));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    async fn take(&self, app: &App, version: &MissingVersion) -> Result<(), FollowError> {
        let MissingVersion { reference, known } = version;
        policies::check_publishable(&reference.name).map_err(ServiceError::from)?;
        let path = format!("/v1/policies/{reference}");
        let Description { created_at } = json(&path, &body(&path, self.get(&path, None).await?, MAX_DESCRIPTION).await?)?;
        let here = match known {
            Some(known) => policies::checkpoint_of(app, known).await.ok(),
            None => None,
        };
        let checkpoint = if let Some(checkpoint) = here {
            checkpoint
        } else {
            let path = format!("{path}/export");
            body(&path, self.get(&path, None).await?, MAX_CHECKPOINT).await?
        };
        Ok(policies::take_over(app, reference.clone(), checkpoint, created_at).await?)
    }

    /// A successful answer, or 304.
    async fn get(&self, path: &str, unless: Option<HeaderValue>) -> Result<Response, FollowError> {
        let mut request = self.client.get(format!("{}{path}", self.url));
        if let Some(authorization) = &self.authorization {
            request = request.header(AUTHORIZATION, authorization.clone());
        }
        if let Some(tag) = unless {
            request = request.header(IF_NONE_MATCH, tag);
        }
        let answer = request.send().await.map_err(reqwest::Error::without_url)?;
        let status = answer.status();
        if status.is_success() || status == StatusCode::NOT_MODIFIED {
            return Ok(answer);
        }
        let hint = match status {
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => "--follow-api-key needs a key of the primary with the scope read",
            StatusCode::NOT_FOUND => "--follow needs the REST address of a server that has it",
            _ => "see the log of the primary",
        };
        Err(FollowError::Refused { path: path.to_owned(), status, hint })
    }
}

/// The body of an answer, of at most `limit` bytes.
async fn body(path: &str, mut answer: Response, limit: usize) -> Result<Vec<u8>, FollowError> {
    let mut bytes = Vec::new();
    while let Some(chunk) = answer.chunk().await.map_err(reqwest::Error::without_url)? {
        if bytes.len() + chunk.len() > limit {
            return Err(FollowError::Malformed { path: path.to_owned(), reason: format!("more than {limit} bytes") });
        }
        bytes.extend_from_slice(&chunk);
    }
    Ok(bytes)
}

fn json<T: for<'a> Deserialize<'a>>(path: &str, bytes: &[u8]) -> Result<T, FollowError> {
    serde_json::from_slice(bytes).map_err(|error| FollowError::Malformed { path: path.to_owned(), reason: error.to_string() })
}
