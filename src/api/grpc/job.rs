//! `qedgix.v1.JobService`.

use std::future::ready;
use std::sync::Arc;

use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt, TryStreamExt};
use tonic::{Request, Response, Status};

use super::GrpcResult;
use crate::api::auth::caller;
use crate::api::convert::jobs::{job_summary, list_request};
use crate::api::convert::structs::from_struct;
use crate::api::errors::stream_status;
use crate::jobs::spec::{ContinueRequest, EditRequest, JobRequest};
use crate::service::jobs::LogLines;
use crate::service::keys::Caller;
use crate::service::worker::MAX_CHUNK;
use crate::service::{App, Error, PageRequest, checkpoints, events, jobs};
use crate::store::JobAction;
use crate::wire::v1;
use crate::wire::v1::job_service_server::{JobService, JobServiceServer};

/// The service.
pub fn service(app: Arc<App>) -> JobServiceServer<impl JobService> {
    JobServiceServer::new(Service(app))
}

struct Service(Arc<App>);

impl Service {
    async fn change(&self, caller: Caller, id: &str, verb: JobAction) -> GrpcResult<v1::Job> {
        Ok(Response::new(jobs::change(&self.0, &caller, id, verb).await?.into()))
    }
}

/// The text, or nothing if it is empty: proto3 strings have no other way to be absent.
fn non_empty(text: &str) -> Option<&str> {
    (!text.is_empty()).then_some(text)
}

#[tonic::async_trait]
impl JobService for Service {
    async fn submit_job(&self, request: Request<v1::SubmitJobRequest>) -> GrpcResult<v1::Job> {
        let caller = caller(request.extensions());
        let v1::SubmitJobRequest { spec, idempotency_key } = request.into_inner();
        let document = from_struct("spec", spec.unwrap_or_default()).map_err(Error::from)?;
        let job = JobRequest::from_json(document).map_err(Error::from)?;
        let key = non_empty(&idempotency_key).map(str::to_owned);
        let (job, _) = jobs::submit(&self.0, &caller, job, key).await?;
        Ok(Response::new(job.into()))
    }

    async fn get_job(&self, request: Request<v1::GetJobRequest>) -> GrpcResult<v1::Job> {
        let caller = caller(request.extensions());
        Ok(Response::new(jobs::show(&self.0, &caller, &request.into_inner().id).await?.into()))
    }

    async fn list_jobs(&self, request: Request<v1::ListJobsRequest>) -> GrpcResult<v1::ListJobsResponse> {
        let caller = caller(request.extensions());
        let request = request.into_inner();
        let page = PageRequest { size: request.page_size, token: request.page_token.clone() };
        let page = jobs::list(&self.0, &caller, list_request(request).map_err(Error::from)?, &page).await?.map(job_summary);
        Ok(Response::new(v1::ListJobsResponse { jobs: page.items, next_page_token: page.next_token }))
    }

    async fn edit_job(&self, request: Request<v1::EditJobRequest>) -> GrpcResult<v1::Job> {
        let caller = caller(request.extensions());
        let v1::EditJobRequest { id, changes } = request.into_inner();
        let document = from_struct("changes", changes.unwrap_or_default()).map_err(Error::from)?;
        let edit = EditRequest::from_json(document).map_err(Error::from)?;
        Ok(Response::new(jobs::edit(&self.0, &caller, &id, edit).await?.into()))
    }

    async fn cancel_job(&self, request: Request<v1::CancelJobRequest>) -> GrpcResult<v1::Job> {
        self.change(caller(request.extensions()), &request.into_inner().id, JobAction::Cancel).await
    }

    async fn pause_job(&self, request: Request<v1::PauseJobRequest>) -> GrpcResult<v1::Job> {
        self.change(caller(request.extensions()), &request.into_inner().id, JobAction::Pause).await
    }

    async fn resume_job(&self, request: Request<v1::ResumeJobRequest>) -> GrpcResult<v1::Job> {
        self.change(caller(request.extensions()), &request.into_inner().id, JobAction::Resume).await
    }

    async fn retry_job(&self, request: Request<v1::RetryJobRequest>) -> GrpcResult<v1::Job> {
        self.change(caller(request.extensions()), &request.into_inner().id, JobAction::Retry).await
    }

    async fn continue_job(&self, request: Request<v1::ContinueJobRequest>) -> GrpcResult<v1::Job> {
        let caller = caller(request.extensions());
        let v1::ContinueJobRequest { id, steps, idempotency_key } = request.into_inner();
        let key = non_empty(&idempotency_key).map(str::to_owned);
        let (job, _) = jobs::continue_job(&self.0, &caller, &id, ContinueRequest { steps }, key).await?;
        Ok(Response::new(job.into()))
    }

    async fn get_job_metrics(&self, request: Request<v1::GetJobMetricsRequest>) -> GrpcResult<v1::GetJobMetricsResponse> {
        let caller = caller(request.extensions());
        let v1::GetJobMetricsRequest { id, name, page_size, page_token } = request.into_inner();
        let page = PageRequest { size: page_size, token: page_token };
        let page = jobs::metrics(&self.0, &caller, &id, non_empty(&name), &page).await?.map(Into::into);
        Ok(Response::new(v1::GetJobMetricsResponse { rows: page.items, next_page_token: page.next_token }))
    }

    type WatchJobStream = BoxStream<'static, Result<v1::JobEvent, Status>>;

    async fn watch_job(&self, request: Request<v1::WatchJobRequest>) -> GrpcResult<Self::WatchJobStream> {
        let (clock, caller) = (self.0.clock.clone(), caller(request.extensions()));
        let v1::WatchJobRequest { id, after } = request.into_inner();
        let events = events::watch(&self.0, &caller, &id, after).await?.events();
        let events = events.and_then(move |event| ready(caller.check(clock.now()).map(|()| event)));
        Ok(Response::new(events.map_ok(Into::into).map_err(stream_status).boxed()))
    }
    async fn delete_job(&self, request: Request<v1::DeleteJobRequest>) -> GrpcResult<v1::DeleteJobResponse> {
        self.change(caller(request.extensions()), &request.into_inner().id, JobAction::Delete).await?;
        Ok(Response::new(v1::DeleteJobResponse {}))
    }

    async fn get_job_logs(&self, request: Request<v1::GetJobLogsRequest>) -> GrpcResult<v1::GetJobLogsResponse> {
        let caller = caller(request.extensions());
        let attempts = jobs::logs(&self.0, &caller, &request.into_inner().id).await?.into_iter().map(Into::into).collect();
        Ok(Response::new(v1::GetJobLogsResponse { attempts }))
    }

    type WatchJobLogsStream = BoxStream<'static, Result<v1::JobOutput, Status>>;

    async fn watch_job_logs(&self, request: Request<v1::WatchJobLogsRequest>) -> GrpcResult<Self::WatchJobLogsStream> {
        let (clock, caller) = (self.0.clock.clone(), caller(request.extensions()));
        let lines = jobs::follow_logs(&self.0, &caller, &request.into_inner().id).await?;
        let lines = lines.and_then(move |lines| ready(caller.check(clock.now()).map(|()| lines)));
        let output = |LogLines { attempt, text }| v1::JobOutput { attempt, text };
        Ok(Response::new(lines.map_ok(output).map_err(stream_status).boxed()))
    }

    async fn get_job_result(&self, request: Request<v1::GetJobResultRequest>) -> GrpcResult<v1::GetJobResultResponse> {
        let caller = caller(request.extensions());
        let result = jobs::result(&self.0, &caller, &request.into_inner().id).await?.to_string();
        Ok(Response::new(v1::GetJobResultResponse { result }))
    }

    async fn list_checkpoints(&self, request: Request<v1::ListCheckpointsRequest>) -> GrpcResult<v1::ListCheckpointsResponse> {
        let caller = caller(request.extensions());
        let checkpoints = jobs::checkpoints(&self.0, &caller, &request.into_inner().id).await?;
        Ok(Response::new(v1::ListCheckpointsResponse { checkpoints: checkpoints.into_iter().map(Into::into).collect() }))
    }

    type DownloadCheckpointStream = BoxStream<'static, Result<v1::CheckpointData, Status>>;

    async fn download_checkpoint(
        &self,
        request: Request<v1::DownloadCheckpointRequest>,
    ) -> GrpcResult<Self::DownloadCheckpointStream> {
        let caller = caller(request.extensions());
        let (_, bytes) = checkpoints::get(&self.0, &caller, &request.into_inner().id).await?;
        let bytes = Bytes::from(bytes);
        let parts = (0..bytes.len()).step_by(MAX_CHUNK).map(move |at| bytes.slice(at..bytes.len().min(at + MAX_CHUNK)));
        Ok(Response::new(futures::stream::iter(parts.map(|data| Ok(v1::CheckpointData { data }))).boxed()))
    }
}
