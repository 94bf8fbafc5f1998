//! The worker's client of `WorkerService`. It adds the credentials to every call, and retries calls that may succeed later.

use std::future::Future;
use std::time::Duration;

use futures::Stream;
use tokio::time::Instant;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Response, Status, Streaming};

use super::Assignment;
use crate::error_code::ErrorCode;
use crate::jobs::Directive;
use crate::wire::v1;
use crate::wire::v1::worker_service_client::WorkerServiceClient;

/// Time for which a failing call is retried: the server may be stopped, or wait for space on its disk. A local worker ends with
/// its server in any case.
const RETRY_TIMEOUT: Duration = Duration::from_secs(3600);
/// Time limit of one call.
const CALL_TIMEOUT: Duration = Duration::from_secs(8);
/// Time limit of one upload or download.
const TRANSFER_TIMEOUT: Duration = Duration::from_secs(600);
/// Time between two tries of a call: the first, which doubles, and the longest.
const RETRY_DELAY: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(2)];
/// Bytes per message of an upload.
pub(super) const CHUNK_SIZE: usize = 1 << 20;

/// Why a call of the worker failed for good.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The server's address or the credentials are malformed.
    #[error("invalid assignment: {0}")]
    Assignment(String),
    /// The attempt has ended, or the credentials are not those of an attempt.
    #[error("this attempt has ended: {0}")]
    AttemptEnded(String),
    /// The server rejected the request.
    #[error("the server rejected the request: {0}")]
    Rejected(String),
    /// The server does not answer.
    #[error("the server does not answer: {0}")]
    Unavailable(String),
}

/// A connection to the server; cheap to clone.
#[derive(Clone)]
pub(super) struct Client(WorkerServiceClient<InterceptedService<Channel, Credentials>>);

/// The metadata of every call.
#[derive(Clone)]
struct Credentials {
    job: MetadataValue<Ascii>,
    attempt: MetadataValue<Ascii>,
    authorization: MetadataValue<Ascii>,
}

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        let metadata = request.metadata_mut();
        metadata.insert("qedgix-job", self.job.clone());
        metadata.insert("qedgix-attempt", self.attempt.clone());
        metadata.insert("authorization", self.authorization.clone());
        Ok(request)
    }
}

impl Client {
    pub(super) fn new(assignment: &Assignment) -> Result<Self, ClientError> {
        let malformed = |what: &str| ClientError::Assignment(format!("{what} is malformed"));
        let value = |what, text: &str| text.parse().map_err(|_| malformed(what));
        let mut authorization: MetadataValue<_> = value("the token", &format!("Bearer {}", assignment.token))?;
        authorization.set_sensitive(true);
        let credentials = Credentials {
            job: value("the job", &assignment.job)?,
            attempt: value("the attempt", &assignment.attempt)?,
            authorization,
        };
        let endpoint = Endpoint::from_shared(assignment.server.clone()).map_err(|_| malformed("the server's address"))?;
        let channel = endpoint.connect_timeout(Duration::from_secs(3)).tcp_nodelay(true).connect_lazy();
        Ok(Self(WorkerServiceClient::with_interceptor(channel, credentials)))
    }

    pub(super) async fn fetch(&self) -> Result<v1::FetchResponse, ClientError> {
        retry(CALL_TIMEOUT, || async { Ok(self.0.clone().fetch(v1::FetchRequest {}).await?.into_inner()) }).await
    }

    pub(super) async fn heartbeat(&self) -> Result<Directive, ClientError> {
        let answer =
            retry(CALL_TIMEOUT, || async { Ok(self.0.clone().heartbeat(v1::HeartbeatRequest {}).await?.into_inner()) }).await?;
        Ok(match answer.directive() {
            v1::Directive::Cancel => Directive::Cancel,
            v1::Directive::Pause => Directive::Pause,
            v1::Directive::Continue | v1::Directive::Unspecified => Directive::Continue,
        })
    }

    pub(super) async fn report(&self, report: &v1::ReportRequest) -> Result<(), ClientError> {
        retry(CALL_TIMEOUT, || async { self.0.clone().report(report.clone()).await.map(drop) }).await
    }

    pub(super) async fn finish(&self, finish: v1::FinishRequest) -> Result<(), ClientError> {
        let finished = retry(CALL_TIMEOUT, || async { self.0.clone().finish(finish.clone()).await.map(drop) }).await;
        match finished {
            // The response to the first try was lost, or the attempt ended otherwise. Nothing is left to do.
            Err(ClientError::AttemptEnded(_)) => Ok(()),
            other => other,
        }
    }

    pub(super) async fn download_snapshot(&self) -> Result<Vec<u8>, ClientError> {
        let request = || v1::DownloadSnapshotRequest {};
        retry(TRANSFER_TIMEOUT, || async { join(self.0.clone().download_snapshot(request()).await?).await }).await
    }

    pub(super) async fn download_initial_weights(&self) -> Result<Vec<u8>, ClientError> {
        let request = || v1::DownloadInitialWeightsRequest {};
        retry(TRANSFER_TIMEOUT, || async { join(self.0.clone().download_initial_weights(request()).await?).await }).await
    }

    pub(super) async fn download_policy(&self, policy: &str) -> Result<Vec<u8>, ClientError> {
        let request = || v1::DownloadPolicyRequest { policy: policy.to_owned() };
        retry(TRANSFER_TIMEOUT, || async { join(self.0.clone().download_policy(request()).await?).await }).await
    }

    /// The policy that the job must be better than, and its checkpoint, which is empty for a baseline; `None`: it does not exist.
    pub(super) async fn download_rival(&self) -> Result<Option<(String, Vec<u8>)>, ClientError> {
        retry(TRANSFER_TIMEOUT, || async {
            let mut parts = self.0.clone().download_rival(v1::DownloadRivalRequest {}).await?.into_inner();
            let Some(first) = parts.message().await? else { return Ok(None) };
            let mut bytes = Vec::new();
            while let Some(part) = parts.message().await? {
                bytes.extend_from_slice(&part.data);
            }
            Ok(Some((first.policy, bytes)))
        })
        .await
    }

    pub(super) async fn upload_snapshot(&self, header: &v1::SnapshotHeader, bytes: &bytes::Bytes) -> Result<(), ClientError> {
        use v1::upload_snapshot_request::Part;
        let parts =
            || parts(Part::Header(header.clone()), bytes, Part::Data, |part| v1::UploadSnapshotRequest { part: Some(part) });
        retry(TRANSFER_TIMEOUT, || async { self.0.clone().upload_snapshot(parts()).await.map(drop) }).await
    }

    pub(super) async fn upload_checkpoint(&self, header: &v1::CheckpointHeader, bytes: &bytes::Bytes) -> Result<(), ClientError> {
        use v1::upload_checkpoint_request::Part;
        let parts =
            || parts(Part::Header(header.clone()), bytes, Part::Data, |part| v1::UploadCheckpointRequest { part: Some(part) });
        retry(TRANSFER_TIMEOUT, || async { self.0.clone().upload_checkpoint(parts()).await.map(drop) }).await
    }
}

/// The file that is sent in chunks.
async fn join(response: Response<Streaming<v1::Chunk>>) -> Result<Vec<u8>, Status> {
    let (mut chunks, mut bytes) = (response.into_inner(), Vec::new());
    while let Some(chunk) = chunks.message().await? {
        bytes.extend_from_slice(&chunk.data);
    }
    Ok(bytes)
}

/// The messages of an upload: a header, then the data in chunks.
fn parts<P, M>(
    header: P,
    bytes: &bytes::Bytes,
    data: fn(bytes::Bytes) -> P,
    message: fn(P) -> M,
) -> impl Stream<Item = M> + use<P, M> {
    let pieces = (0..bytes.len()).step_by(CHUNK_SIZE).map(|at| data(bytes.slice(at..bytes.len().min(at + CHUNK_SIZE))));
    let messages: Vec<M> = std::iter::once(header).chain(pieces).map(message).collect();
    futures::stream::iter(messages)
}

/// Whether the server answers that it cannot write its database.
fn is_storage_failure(status: &Status) -> bool {
    let code = status.metadata().get("qedgix-code").and_then(|code| code.to_str().ok());
    code.is_some_and(|code| [ErrorCode::StorageFull, ErrorCode::StorageFailed].iter().any(|failure| failure.as_str() == code))
}

/// Retries a call until it succeeds, is rejected, or has failed for [`RETRY_TIMEOUT`]. While the server cannot write its
/// database, another attempt would fail in the same way, so this one waits: training goes on, and no attempt is lost.
async fn retry<T, F>(limit: Duration, call: impl Fn() -> F) -> Result<T, ClientError>
where
    F: Future<Output = Result<T, Status>>,
{
    let mut failing_since = None;
    let [mut delay, longest] = RETRY_DELAY;
    loop {
        let status = match tokio::time::timeout(limit, call()).await {
            Ok(Ok(answer)) => return Ok(answer),
            Ok(Err(status)) => status,
            Err(_) => Status::deadline_exceeded(format!("no response within {} s", limit.as_secs())),
        };
        if is_storage_failure(&status) {
            tracing::debug!(message = status.message(), "the server cannot write its database; trying again");
            failing_since = None;
            tokio::time::sleep(delay).await;
            delay = (delay * 2).min(longest);
            continue;
        }
        let text = format!("{:?}: {}", status.code(), status.message());
        match status.code() {
            Code::Unauthenticated | Code::PermissionDenied | Code::FailedPrecondition | Code::NotFound => {
                return Err(ClientError::AttemptEnded(text));
            }
            Code::InvalidArgument | Code::OutOfRange | Code::Unimplemented => return Err(ClientError::Rejected(text)),
            _ => {}
        }
        // Measured from the first failure, because a transfer may take longer than this.
        if failing_since.get_or_insert_with(Instant::now).elapsed() > RETRY_TIMEOUT {
            return Err(ClientError::Unavailable(text));
        }
        tokio::time::sleep(delay).await;
        delay = (delay * 2).min(longest);
    }
}
