//! The worker's side of `WorkerService`: every call signed, and repeated while the server may only be busy.

use std::future::Future;
use std::time::Duration;

use futures::Stream;
use tokio::time::Instant;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

use super::Assignment;
use crate::jobs::Directive;
use crate::wire::v1;
use crate::wire::v1::worker_service_client::WorkerServiceClient;

/// A server that does not answer for this long is gone: another attempt begins elsewhere.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time one call may take.
const CALL: Duration = Duration::from_secs(8);
/// Time one upload or download may take.
const TRANSFER: Duration = Duration::from_secs(600);
/// Pause before a call is repeated.
const PAUSE: Duration = Duration::from_millis(200);
/// Bytes per message of an upload.
pub(super) const CHUNK: usize = 1 << 20;

/// Why a worker cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum Lost {
    /// The address or the credentials cannot be used at all.
    #[error("the assignment cannot be used: {0}")]
    Assignment(String),
    /// The attempt is over, or was never this worker's.
    #[error("this attempt is over: {0}")]
    Over(String),
    /// The server does not accept what it was sent.
    #[error("the server refuses: {0}")]
    Refused(String),
    /// The server does not answer.
    #[error("the server is gone: {0}")]
    Gone(String),
}

/// A connection to the server; cheap to clone.
#[derive(Clone)]
pub(super) struct Client(WorkerServiceClient<InterceptedService<Channel, Signature>>);

/// What every call carries.
#[derive(Clone)]
struct Signature {
    job: MetadataValue<Ascii>,
    attempt: MetadataValue<Ascii>,
    authorization: MetadataValue<Ascii>,
}

impl Interceptor for Signature {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        let metadata = request.metadata_mut();
        metadata.insert("qedgix-job", self.job.clone());
        metadata.insert("qedgix-attempt", self.attempt.clone());
        metadata.insert("authorization", self.authorization.clone());
        Ok(request)
    }
}

impl Client {
    pub(super) fn new(assignment: &Assignment) -> Result<Self, Lost> {
        let unusable = |what: &str| Lost::Assignment(format!("{what} is malformed"));
        let value = |what, text: &str| text.parse().map_err(|_| unusable(what));
        let mut authorization: MetadataValue<_> = value("the token", &format!("Bearer {}", assignment.token))?;
        authorization.set_sensitive(true);
        let signature = Signature {
            job: value("the job", &assignment.job)?,
            attempt: value("the attempt", &assignment.attempt)?,
            authorization,
        };
        let endpoint = Endpoint::from_shared(assignment.server.clone()).map_err(|_| unusable("the server's address"))?;
        let channel = endpoint.connect_timeout(Duration::from_secs(3)).tcp_nodelay(true).connect_lazy();
        Ok(Self(WorkerServiceClient::with_interceptor(channel, signature)))
    }

    pub(super) async fn fetch(&self) -> Result<v1::FetchResponse, Lost> {
        repeat(CALL, || async { Ok(self.0.clone().fetch(v1::FetchRequest {}).await?.into_inner()) }).await
    }

    pub(super) async fn heartbeat(&self) -> Result<Directive, Lost> {
        let answer = repeat(CALL, || async { Ok(self.0.clone().heartbeat(v1::HeartbeatRequest {}).await?.into_inner()) }).await?;
        Ok(match answer.directive() {
            v1::Directive::Cancel => Directive::Cancel,
            v1::Directive::Pause => Directive::Pause,
            v1::Directive::Continue | v1::Directive::Unspecified => Directive::Continue,
        })
    }

    pub(super) async fn report(&self, report: &v1::ReportRequest) -> Result<(), Lost> {
        repeat(CALL, || async { self.0.clone().report(report.clone()).await.map(drop) }).await
    }

    pub(super) async fn finish(&self, finish: v1::FinishRequest) -> Result<(), Lost> {
        let finished = repeat(CALL, || async { self.0.clone().finish(finish.clone()).await.map(drop) }).await;
        match finished {
            // The first answer was lost, or somebody ended the attempt meanwhile: over is what it is.
            Err(Lost::Over(_)) => Ok(()),
            other => other,
        }
    }

    pub(super) async fn download_snapshot(&self) -> Result<Vec<u8>, Lost> {
        repeat(TRANSFER, || async {
            let mut chunks = self.0.clone().download_snapshot(v1::DownloadSnapshotRequest {}).await?.into_inner();
            let mut bytes = Vec::new();
            while let Some(chunk) = chunks.message().await? {
                bytes.extend_from_slice(&chunk.data);
            }
            Ok(bytes)
        })
        .await
    }

    pub(super) async fn upload_snapshot(&self, header: &v1::SnapshotHeader, bytes: &bytes::Bytes) -> Result<(), Lost> {
        use v1::upload_snapshot_request::Part;
        let parts =
            || parts(Part::Header(header.clone()), bytes, Part::Data, |part| v1::UploadSnapshotRequest { part: Some(part) });
        repeat(TRANSFER, || async { self.0.clone().upload_snapshot(parts()).await.map(drop) }).await
    }

    pub(super) async fn upload_checkpoint(&self, header: &v1::CheckpointHeader, bytes: &bytes::Bytes) -> Result<(), Lost> {
        use v1::upload_checkpoint_request::Part;
        let parts =
            || parts(Part::Header(header.clone()), bytes, Part::Data, |part| v1::UploadCheckpointRequest { part: Some(part) });
        repeat(TRANSFER, || async { self.0.clone().upload_checkpoint(parts()).await.map(drop) }).await
    }
}

/// The messages of an upload: a header, then the data piece by piece.
fn parts<P, M>(
    header: P,
    bytes: &bytes::Bytes,
    data: fn(bytes::Bytes) -> P,
    message: fn(P) -> M,
) -> impl Stream<Item = M> + use<P, M> {
    let pieces = (0..bytes.len()).step_by(CHUNK).map(|at| data(bytes.slice(at..bytes.len().min(at + CHUNK))));
    let messages: Vec<M> = std::iter::once(header).chain(pieces).map(message).collect();
    futures::stream::iter(messages)
}

/// Calls until there is an answer, a refusal, or the server has been silent for too long.
async fn repeat<T, F>(limit: Duration, call: impl Fn() -> F) -> Result<T, Lost>
where
    F: Future<Output = Result<T, Status>>,
{
    let mut failing_since = None;
    loop {
        let status = match tokio::time::timeout(limit, call()).await {
            Ok(Ok(answer)) => return Ok(answer),
            Ok(Err(status)) => status,
            Err(_) => Status::deadline_exceeded(format!("no answer within {} s", limit.as_secs())),
        };
        let text = format!("{:?}: {}", status.code(), status.message());
        match status.code() {
            Code::Unauthenticated | Code::PermissionDenied | Code::FailedPrecondition | Code::NotFound => {
                return Err(Lost::Over(text));
            }
            Code::InvalidArgument | Code::OutOfRange | Code::Unimplemented => return Err(Lost::Refused(text)),
            _ => {}
        }
        // From the first failure on: a long transfer that breaks off had a server until then.
        if failing_since.get_or_insert_with(Instant::now).elapsed() > PATIENCE {
            return Err(Lost::Gone(text));
        }
        tokio::time::sleep(PAUSE).await;
    }
}
