//! What jobs begin with: the weights of a policy or a checkpoint, or what another job has reached.

use bytes::Bytes;

use crate::checkpoint::{self, Checkpoint};
use crate::error_code::ErrorCode;
use crate::invalid::{Invalid, in_range};
use crate::jobs::memory::default_limit;
use crate::jobs::spec::{ContinueRequest, InitRequest};
use crate::service::keys::Caller;
use crate::service::{App, Error, checkpoints, policies};
use crate::serving::PolicySpec;
use crate::store::{Beginning, CheckpointKind, InitKind, Job, JobInit, JobLimits, JobSpec};
use crate::train_config::{TrainConfig, Training};

/// Weights that jobs begin with.
pub(super) struct InitialWeights {
    init: JobInit,
    checkpoint: Checkpoint,
    bytes: Bytes,
}

impl InitialWeights {
    /// The weights of a request, in the version that they have now.
    ///
    /// # Errors
    /// [`Error::Invalid`] with the field that names no weights.
    pub(super) async fn find(app: &App, caller: &Caller, request: &InitRequest) -> Result<Self, Error> {
        let mut init =
            JobInit { from: InitKind::Weights, policy: None, checkpoint: None, job: None, step: 0, sha256: String::new() };
        let (field, bytes) = match (&request.policy, &request.checkpoint) {
            (Some(name), None) => {
                let unknown = || Invalid::new("init.policy", format!("{name:?}"), "a policy of this server that is no baseline");
                let spec: PolicySpec = name.parse().map_err(|_| unknown())?;
                let (reference, bytes) = match policies::export(app, &spec).await {
                    Err(Error::NotFound { .. } | Error::Precondition { .. }) => return Err(unknown().into()),
                    found => found?,
                };
                init.policy = Some(format!("{}:{}", reference.name, reference.version));
                ("init.policy", bytes)
            }
            (None, Some(id)) => {
                let unknown = || Invalid::new("init.checkpoint", format!("{id:?}"), "the id of a checkpoint of a job");
                let (found, bytes) = match checkpoints::get(app, caller, id).await {
                    Err(Error::NotFound { .. }) => return Err(unknown().into()),
                    found => found?,
                };
                init.checkpoint = Some(found.id);
                ("init.checkpoint", bytes)
            }
            _ => return Err(Invalid::missing("init.policy", "exactly one of policy and checkpoint").into()),
        };
        Self::parse(init, field, bytes).await
    }

    async fn parse(init: JobInit, field: &'static str, bytes: Vec<u8>) -> Result<Self, Error> {
        // Hashing and parsing large weights takes too long for a thread that serves connections.
        let parse = move || {
            let checkpoint = Checkpoint::from_bytes(&bytes)
                .map_err(|e| Invalid::new(field, e.to_string(), "a checkpoint that this version can read"))?;
            let init = JobInit { step: checkpoint.env_steps(), sha256: checkpoint::digest(&bytes), ..init };
            Ok(Self { init, checkpoint, bytes: bytes.into() })
        };
        tokio::task::spawn_blocking(parse).await.map_err(Error::internal)?
    }

    /// Lets the job begin with these weights.
    ///
    /// # Errors
    /// [`Invalid`] with the field of the job whose architecture differs.
    pub(super) fn put_into(&self, spec: &mut JobSpec) -> Result<Beginning, Invalid> {
        if let Some(config) = &spec.config {
            self.checkpoint.check_architecture(config)?;
        }
        spec.init = Some(self.init.clone());
        Ok(Beginning::Weights(self.init.sha256.clone(), self.bytes.clone()))
    }
}

/// The specification of a job that continues the training job `job`, which has ended: from its snapshot if that is kept, or else
/// from its last weights.
///
/// # Errors
/// [`Error::Precondition`] when the job has not ended, does not train or has neither. [`Error::Invalid`]: the steps.
pub(super) async fn continued(
    app: &App,
    caller: &Caller,
    job: &Job,
    request: ContinueRequest,
) -> Result<(JobSpec, Beginning), Error> {
    let wrong_state = |why: &str| {
        let message = format!("job {} {why}", job.id);
        Error::Precondition { code: ErrorCode::WrongState, message }
    };
    let spec = job.spec.decode().map_err(|e| wrong_state(&format!("cannot be continued: {e}")))?;
    let Some(config) = spec.config.clone() else { return Err(wrong_state("does not train, so it cannot be continued")) };
    if !job.state.ended() {
        return Err(wrong_state(&format!("is {}; only a job that has ended can be continued", job.state)));
    }
    let most = TrainConfig::MAX_STEPS;
    in_range("steps", request.steps, 1..=most)?;
    let labels = spec.labels.clone();
    let spec = JobSpec {
        name: job.spec.name.clone(),
        labels,
        after: Vec::new(),
        webhooks: Vec::new(),
        report: None,
        point: None,
        ..spec
    };
    if let Some(snapshot) = app.store.snapshot(job.id).await? {
        let init = JobInit {
            from: InitKind::Snapshot,
            policy: None,
            checkpoint: None,
            job: Some(job.id),
            step: snapshot.step,
            sha256: snapshot.sha256.clone(),
        };
        let least = config.training.steps.saturating_sub(snapshot.step).max(1);
        let room = most.saturating_sub(snapshot.step);
        if !(least..=room).contains(&request.steps) {
            let expected = format!(
                "a number from {least} to {room}: the snapshot of the job is at step {} of {}",
                snapshot.step, config.training.steps
            );
            return Err(Invalid::new("steps", request.steps, expected).into());
        }
        let steps = snapshot.step + request.steps;
        let training = Training { steps, ..config.training.clone() };
        let config = TrainConfig { training, ..config };
        let spec = JobSpec { init: Some(init), limits: enough_memory(&spec, &config), config: Some(config), ..spec };
        return Ok((spec, Beginning::Snapshot(snapshot)));
    }
    let last = app.store.checkpoints(job.id).await?.into_iter().max_by_key(|c| c.kind == CheckpointKind::Last);
    let Some(last) = last else { return Err(wrong_state("has neither a snapshot nor weights to continue from")) };
    let weights = InitRequest { policy: None, checkpoint: Some(last.id.to_string()) };
    let weights = InitialWeights::find(app, caller, &weights).await?;
    let training = config.training.continued(last.step, request.steps);
    let config = TrainConfig { training, ..config };
    let mut spec = JobSpec { limits: enough_memory(&spec, &config), config: Some(config), ..spec };
    let beginning = weights.put_into(&mut spec)?;
    spec.init = spec.init.map(|init| JobInit { job: Some(job.id), ..init });
    Ok((spec, beginning))
}

/// The limits of a job that is continued with `config`, whose replay may be larger.
fn enough_memory(spec: &JobSpec, config: &TrainConfig) -> JobLimits {
    let memory = spec.limits.memory.map(|memory| memory.max(default_limit(config, spec.threads)));
    JobLimits { memory, ..spec.limits }
}
