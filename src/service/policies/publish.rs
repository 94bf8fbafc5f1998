//! Publishes checkpoints as versions of policies.

use jiff::Timestamp;

use super::aliases::{check_alias, unloaded};
use super::deletion::retain_after_publishing;
use super::info::{self, PolicyDetails, complete};
use super::promotion::JobResult;
use super::stored::{CheckpointBytes, ParsedCheckpoint};
use super::upload_limit::UploadPermit;
use super::{PolicyStores, one_at_a_time};
use crate::invalid::Invalid;
use crate::policy::baselines;
use crate::service::keys::{Caller, Scope};
use crate::service::{App, Error, checkpoints};
use crate::serving::bundled::BUNDLED;
use crate::serving::{PolicyRef, PolicySpec, Registry, VersionSelector, check_name};
use crate::store::{EndedAttempt, Job, Lease, NewPolicyVersion, PublishedPolicy};

/// The checkpoint to publish.
#[derive(Debug)]
pub enum CheckpointSource {
    /// A checkpoint as safetensors, and the permit to hold it in memory.
    Bytes(Vec<u8>, UploadPermit),
    /// The id of a job's checkpoint.
    Job(String),
}

/// A request to publish a checkpoint.
#[derive(Debug)]
pub struct PublishRequest {
    /// Name of the policy; it may be new.
    pub name: String,
    /// The checkpoint.
    pub source: CheckpointSource,
    /// An alias to point to the version.
    pub alias: Option<String>,
}

/// On whose behalf a checkpoint is published.
#[derive(Clone, Debug, Default)]
pub struct Publisher {
    /// The owner; `None`: nobody, on a server without keys.
    pub owner: Option<String>,
    /// Whether the name may be one that another owner made.
    pub any_name: bool,
    /// Id of the API key.
    pub key: Option<String>,
}

impl Publisher {
    /// The program itself, which publishes the bundled policies.
    pub(super) const PROGRAM: Self = Self { owner: None, any_name: true, key: None };
}

impl From<&Caller> for Publisher {
    fn from(caller: &Caller) -> Self {
        let owner = caller.owner().id().map(str::to_owned);
        Self { owner, any_name: caller.is_admin(), key: caller.key_id().map(str::to_owned) }
    }
}

/// Checks that `publisher` may publish under `name`: nobody else made that name, or the publisher may use any.
///
/// # Errors
/// [`Error::PermissionDenied`].
pub async fn check_owner(app: &App, publisher: &Publisher, name: &str) -> Result<(), Error> {
    let made_by = if publisher.any_name { None } else { app.store.policy_owner(name).await? };
    let taken = made_by.is_some_and(|owner| owner != publisher.owner);
    let bundled = !publisher.any_name && publisher.owner.is_some() && BUNDLED.iter().any(|(bundled, _)| *bundled == name);
    if taken || bundled { Err(name_taken(name)) } else { Ok(()) }
}

fn name_taken(name: &str) -> Error {
    let scope = Scope::Admin.name();
    let message = format!("another owner made the policy {name}; choose another name, or use a key with the scope {scope}");
    Error::PermissionDenied { message, scope }
}

/// Checks that a policy may be published as `name`.
///
/// # Errors
/// [`Invalid`] for a malformed name or the name of a baseline.
pub fn check_publishable(name: &str) -> Result<(), Invalid> {
    check_name("name", name)?;
    if baselines::is_name(name) {
        return Err(Invalid::new("name", format!("{name:?}"), "a name that no baseline has"));
    }
    Ok(())
}

/// Publishes a checkpoint (safetensors) as the next version of policy `name` and loads it. Publishing identical bytes returns
/// the existing version, loaded or not.
///
/// # Errors
/// [`Error::Invalid`] for a name or bytes that cannot be published, [`Error::PermissionDenied`] when another owner made the name,
/// [`Error::Internal`] when the database fails.
pub async fn publish_bytes(app: &App, publisher: Publisher, name: &str, bytes: Vec<u8>) -> Result<PolicyRef, Error> {
    let version = NewVersion::parse(app, publisher, name, CheckpointBytes { bytes, _permit: None }).await?;
    let (reference, _) = version.publish(app, None).await?;
    Ok(reference)
}

/// Publishes a checkpoint, uploaded or of a job, on request of a caller. Returns the version, and whether it is new.
///
/// # Errors
/// As [`publish_bytes`]; [`Error::NotFound`] for an unknown checkpoint, [`Error::Precondition`] for an alias to an unloaded version,
/// [`Error::Draining`].
pub async fn publish(app: &App, caller: &Caller, request: PublishRequest) -> Result<(PolicyDetails, bool), Error> {
    app.admit()?;
    let PublishRequest { name, source, alias } = request;
    check_publishable(&name)?;
    check_owner(app, &caller.into(), &name).await?;
    if let Some(alias) = &alias {
        check_name("alias", alias)?;
    }
    let checkpoint = match source {
        CheckpointSource::Bytes(bytes, permit) => CheckpointBytes { bytes, _permit: Some(permit) },
        CheckpointSource::Job(id) => CheckpointBytes { bytes: checkpoints::get(app, caller, &id).await?.1, _permit: None },
    };
    let (reference, new) = NewVersion::parse(app, caller.into(), &name, checkpoint).await?.publish(app, alias).await?;
    let spec = PolicySpec { name, version: VersionSelector::Version(reference.version) };
    let published = complete(app, app.registry.describe(&spec)?).await?;
    retain_after_publishing(app, &spec.name).await;
    Ok((published, new))
}

/// Ends the attempt of a job that succeeded, publishes `version`, and moves the alias of the promotion if its condition holds, in one
/// transaction. Nothing is published if the job is being cancelled. Returns the job, or `None` if the attempt has already ended.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub(in crate::service) async fn publish_and_end(
    app: &App,
    version: NewVersion,
    result: JobResult<'_>,
    lease: Lease,
) -> Result<Option<Job>, Error> {
    let (max_attempts, now) = (app.scheduler.config().max_attempts, app.clock.now());
    let name = version.name.clone();
    let JobResult { ended, promotion, document } = result;
    let (result, document) = (ended.clone(), document.map(str::to_owned));
    let job = one_at_a_time(app, async move |PolicyStores { store, registry }| {
        // Policies do not change between the decision and the transaction.
        let decision = promotion.as_ref().map(|p| (p, p.decide(&registry, &version.name, &version.parsed.digest)));
        let alias = decision.as_ref().filter(|(_, decision)| decision.is_ok()).map(|(promotion, _)| promotion.alias.as_str());
        let document = decision.as_ref().map(|(promotion, decision)| promotion.document(decision).to_string()).or(document);
        let (new, document) = (version.row(now, alias), document.as_deref());
        let ended = EndedAttempt { lease, result: &result, publish: Some(new), document, max_attempts, now };
        let Some((job, published)) = store.end_attempt(ended).await? else { return Ok(None) };
        if let Some(published) = published {
            version.register(&registry, published, alias);
        }
        Ok(Some(job))
    })
    .await?;
    retain_after_publishing(app, &name).await;
    Ok(job)
}

/// A parsed checkpoint that is to become a version of policy `name`.
pub(in crate::service) struct NewVersion {
    publisher: Publisher,
    name: String,
    digest_hex: String,
    /// What lists show of it, as JSON.
    info: String,
    parsed: ParsedCheckpoint,
}

impl NewVersion {
    /// Checks the name and parses a checkpoint that is already in memory, such as the best one of a job.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a name or bytes that cannot be published.
    pub(in crate::service) async fn from_bytes(
        app: &App,
        publisher: Publisher,
        name: &str,
        bytes: Vec<u8>,
    ) -> Result<Self, Error> {
        Self::parse(app, publisher, name, CheckpointBytes { bytes, _permit: None }).await
    }

    async fn parse(app: &App, publisher: Publisher, name: &str, source: CheckpointBytes) -> Result<Self, Error> {
        check_publishable(name)?;
        let parsed = ParsedCheckpoint::parse(source).await?;
        let reference = PolicyRef { name: name.to_owned(), version: 0, digest: parsed.digest };
        let info = info::to_json(&parsed.describe(reference, app.clock.now()))?;
        Ok(Self { publisher, name: name.to_owned(), digest_hex: hex::encode(parsed.digest), info, parsed })
    }

    fn row<'a>(&'a self, now: Timestamp, alias: Option<&'a str>) -> NewPolicyVersion<'a> {
        let Self { publisher: Publisher { owner, any_name, key }, name, digest_hex: digest, info, parsed } = self;
        let (owner, by, any_name, checkpoint) = (owner.as_deref(), key.as_deref(), *any_name, &parsed.source.bytes);
        NewPolicyVersion { name, digest, checkpoint, info, now, alias, by, owner, any_name }
    }

    /// Publishes the version. Returns it, and whether it is new.
    async fn publish(self, app: &App, alias: Option<String>) -> Result<(PolicyRef, bool), Error> {
        let now = app.clock.now();
        one_at_a_time(app, async move |PolicyStores { store, registry }| {
            if let Some(alias) = &alias {
                check_alias(&registry, &self.name, alias)?;
                let known = registry.version_of_digest(&self.name, &self.parsed.digest);
                if let Some(known) = known.filter(|known| !known.loaded) {
                    return Err(unloaded(&known.reference));
                }
            }
            let published = store.publish_policy(self.row(now, alias.as_deref())).await?;
            let published = published.ok_or_else(|| name_taken(&self.name))?;
            Ok((self.register(&registry, published, alias.as_deref()), published.new))
        })
        .await
    }

    /// Adds the version to the registry, after it was committed to the database, and keeps it in memory if there is free memory. A
    /// known version stays as it is: loaded or unloaded.
    fn register(self, registry: &Registry, published: PublishedPolicy, alias: Option<&str>) -> PolicyRef {
        let reference = PolicyRef { name: self.name, version: published.version, digest: self.parsed.digest };
        if registry.version_of_digest(&reference.name, &reference.digest).is_none() {
            registry.add(reference.clone());
            if let Some(share) = registry.take_free_memory(self.parsed.source.bytes.len()) {
                registry.keep(self.parsed.into_policy(reference.clone(), published.created_at, share));
            }
        }
        if let Some(alias) = alias {
            registry.set_alias(&reference.name, alias, reference.version);
        }
        if published.new {
            tracing::info!(policy = %reference, digest = reference.digest_hex(), alias, "policy published");
        }
        reference
    }
}
