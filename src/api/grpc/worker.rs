//! `qedgix.v1.WorkerService`.

use std::pin::Pin;
use std::sync::Arc;

use bytes::Bytes;
use futures::Stream;
use serde::Serialize;
use tonic::metadata::MetadataMap;
use tonic::{Request, Response, Status, Streaming};

use super::{GrpcResult, upload};
use crate::api::errors::stream_status;
use crate::service::worker::{self, CheckpointUpload, Credentials, MAX_CHUNK, SnapshotUpload, UploadHeader};
use crate::service::{App, Error};
use crate::store::{Lease, Metric};
use crate::wire::v1;
use crate::wire::v1::worker_service_server::{WorkerService, WorkerServiceServer};

/// Maximum size of a message of a worker in bytes, independent of the limit for other messages: a chunk with its framing.
pub const MAX_WORKER_MESSAGE: usize = 4 << 20;

/// The service.
pub fn service(app: Arc<App>) -> WorkerServiceServer<impl WorkerService> {
    WorkerServiceServer::new(Service(app))
}

struct Service(Arc<App>);

impl Service {
    async fn lease(&self, metadata: &MetadataMap) -> Result<Lease, Error> {
        const MISSING: Error =
            Error::Unauthenticated("missing metadata: a worker sends qedgix-job, qedgix-attempt and authorization: Bearer TOKEN");
        let text = |key| metadata.get(key).and_then(|value| value.to_str().ok()).ok_or(MISSING);
        let token = text("authorization")?.strip_prefix("Bearer ").ok_or(MISSING)?;
        let (job, attempt) = (text("qedgix-job")?.to_owned(), text("qedgix-attempt")?.to_owned());
        worker::authenticate(&self.0, &Credentials { job, attempt, token: token.to_owned() }).await
    }
}

/// A document as JSON text; empty: none.
fn json_text(document: Option<&impl Serialize>) -> Result<String, Error> {
    document.map_or_else(|| Ok(String::new()), |document| serde_json::to_string(document).map_err(Error::internal))
}

type ChunkStream = Pin<Box<dyn Stream<Item = Result<v1::Chunk, Status>> + Send>>;

/// A file in chunks.
fn chunks(bytes: Vec<u8>) -> Response<ChunkStream> {
    let bytes = Bytes::from(bytes);
    let parts = (0..bytes.len()).step_by(MAX_CHUNK).map(move |at| bytes.slice(at..bytes.len().min(at + MAX_CHUNK)));
    Response::new(Box::pin(futures::stream::iter(parts.map(|data| Ok(v1::Chunk { data })))))
}

#[tonic::async_trait]
impl WorkerService for Service {
    async fn fetch(&self, request: Request<v1::FetchRequest>) -> GrpcResult<v1::FetchResponse> {
        let lease = self.lease(request.metadata()).await?;
        let task = worker::fetch(&self.0, lease).await?;
        Ok(Response::new(v1::FetchResponse {
            config: json_text(task.config.as_ref())?,
            evaluation: json_text(task.evaluation.as_ref())?,
            threads: task.threads as u32,
            snapshot_step: task.snapshot.map(|snapshot| snapshot.step),
            snapshot_every_ms: task.snapshot_every.as_millis() as u64,
            initial_weights: task.initial_weights,
            rival: task.rival,
            memory: task.memory,
            report: json_text(task.report.as_ref())?,
            stop: json_text(task.stop.as_ref())?,
            observed: task.observed.into_iter().map(Into::into).collect(),
        }))
    }

    type DownloadSnapshotStream = ChunkStream;

    async fn download_snapshot(&self, request: Request<v1::DownloadSnapshotRequest>) -> GrpcResult<Self::DownloadSnapshotStream> {
        let lease = self.lease(request.metadata()).await?;
        let snapshot = worker::snapshot(&self.0, lease).await?;
        let app = Arc::clone(&self.0);
        let chunks = futures::stream::try_unfold(0, move |index| {
            let (app, snapshot) = (Arc::clone(&app), snapshot.clone());
            async move {
                let chunk = worker::snapshot_chunk(&app, &snapshot, index).await.map_err(stream_status)?;
                Ok(chunk.map(|data| (v1::Chunk { data: data.into() }, index + 1)))
            }
        });
        Ok(Response::new(Box::pin(chunks)))
    }

    type DownloadPolicyStream = ChunkStream;

    async fn download_policy(&self, request: Request<v1::DownloadPolicyRequest>) -> GrpcResult<Self::DownloadPolicyStream> {
        let lease = self.lease(request.metadata()).await?;
        Ok(chunks(worker::policy(&self.0, lease, &request.into_inner().policy).await?))
    }

    type DownloadInitialWeightsStream = ChunkStream;

    async fn download_initial_weights(
        &self,
        request: Request<v1::DownloadInitialWeightsRequest>,
    ) -> GrpcResult<Self::DownloadInitialWeightsStream> {
        let lease = self.lease(request.metadata()).await?;
        Ok(chunks(worker::initial_weights(&self.0, lease).await?))
    }

    type DownloadRivalStream = Pin<Box<dyn Stream<Item = Result<v1::RivalPart, Status>> + Send>>;

    async fn download_rival(&self, request: Request<v1::DownloadRivalRequest>) -> GrpcResult<Self::DownloadRivalStream> {
        let lease = self.lease(request.metadata()).await?;
        let Some((policy, bytes)) = worker::rival(&self.0, lease).await? else {
            return Ok(Response::new(Box::pin(futures::stream::empty())));
        };
        let bytes = Bytes::from(bytes);
        let first = v1::RivalPart { policy, data: Bytes::new() };
        let parts = (0..bytes.len()).step_by(MAX_CHUNK).map(move |at| bytes.slice(at..bytes.len().min(at + MAX_CHUNK)));
        let parts = parts.map(|data| v1::RivalPart { policy: String::new(), data });
        Ok(Response::new(Box::pin(futures::stream::iter(std::iter::once(first).chain(parts).map(Ok)))))
    }

    async fn report(&self, request: Request<v1::ReportRequest>) -> GrpcResult<v1::ReportResponse> {
        let lease = self.lease(request.metadata()).await?;
        let v1::ReportRequest { metrics, step } = request.into_inner();
        let metrics: Vec<Metric> = metrics.into_iter().map(Into::into).collect();
        worker::report(&self.0, lease, &metrics, step).await?;
        Ok(Response::new(v1::ReportResponse {}))
    }

    async fn upload_snapshot(
        &self,
        request: Request<Streaming<v1::UploadSnapshotRequest>>,
    ) -> GrpcResult<v1::UploadSnapshotResponse> {
        let lease = self.lease(request.metadata()).await?;
        let mut messages = request.into_inner();
        let header = upload::header(&mut messages).await?;
        let declared = UploadHeader { size: header.size, sha256: header.sha256 };
        let mut snapshot = SnapshotUpload::begin(&self.0, lease, header.step, declared).await?;
        while let Some(data) = upload::chunk(&mut messages).await? {
            snapshot.push(&self.0, data).await?;
        }
        snapshot.complete(&self.0).await?;
        Ok(Response::new(v1::UploadSnapshotResponse {}))
    }

    async fn upload_checkpoint(
        &self,
        request: Request<Streaming<v1::UploadCheckpointRequest>>,
    ) -> GrpcResult<v1::UploadCheckpointResponse> {
        let lease = self.lease(request.metadata()).await?;
        let mut messages = request.into_inner();
        let header = upload::header(&mut messages).await?;
        let size = header.size;
        let mut checkpoint = CheckpointUpload::begin(lease, header.try_into().map_err(Error::from)?, size)?;
        while let Some(data) = upload::chunk(&mut messages).await? {
            checkpoint.push(data).await?;
        }
        let id = checkpoint.complete(&self.0).await?;
        Ok(Response::new(v1::UploadCheckpointResponse { id: id.to_string() }))
    }

    async fn heartbeat(&self, request: Request<v1::HeartbeatRequest>) -> GrpcResult<v1::HeartbeatResponse> {
        let lease = self.lease(request.metadata()).await?;
        let directive = worker::heartbeat(&self.0, lease).await?;
        Ok(Response::new(v1::HeartbeatResponse { directive: v1::Directive::from(directive).into() }))
    }

    async fn finish(&self, request: Request<v1::FinishRequest>) -> GrpcResult<v1::FinishResponse> {
        let lease = self.lease(request.metadata()).await?;
        let mut request = request.into_inner();
        let document = Some(std::mem::take(&mut request.result)).filter(|document| !document.is_empty());
        worker::finish(&self.0, lease, request.try_into().map_err(Error::from)?, document).await?;
        Ok(Response::new(v1::FinishResponse {}))
    }
}
