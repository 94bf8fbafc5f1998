//! `GRPCInferenceService` of the Open Inference Protocol.

mod messages;
mod tools;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use futures::stream::{BoxStream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

use self::messages::{config, final_response, infer_request, infer_response, metadata};
use super::{GrpcResult, deadline, stream};
use crate::api::auth::{caller, count_message};
use crate::api::errors::act_error;
use crate::api::oip;
use crate::service::keys::Caller;
use crate::service::{App, Error};
use crate::wire::oip as wire;
use crate::wire::oip::grpc_inference_service_server::{GrpcInferenceService, GrpcInferenceServiceServer};
use crate::wire::v1::ActError;

/// The service.
pub fn service(app: Arc<App>) -> GrpcInferenceServiceServer<impl GrpcInferenceService> {
    GrpcInferenceServiceServer::new(Service(app))
}

struct Service(Arc<App>);

async fn infer(
    app: &App,
    caller: &Caller,
    request: wire::ModelInferRequest,
    deadline: Option<Instant>,
) -> Result<wire::ModelInferResponse, Error> {
    Ok(infer_response(oip::infer(app, caller, infer_request(request)?, deadline).await?))
}

/// The response to one request of a stream. `counted` refuses the request if the caller exceeds its rate.
async fn infer_in_stream(
    app: &App,
    caller: &Caller,
    request: wire::ModelInferRequest,
    counted: Result<(), Error>,
    deadline: Option<Instant>,
) -> wire::ModelStreamInferResponse {
    let (model_name, id) = (request.model_name.clone(), request.id.clone());
    let inferred = match counted {
        Ok(()) => infer(app, caller, request, deadline).await,
        Err(busy) => Err(busy),
    };
    let (error_message, mut response) = match inferred {
        Ok(response) => (String::new(), response),
        Err(error) => {
            let ActError { code, message, field, .. } = act_error(&error);
            let mut parameters = HashMap::from([("code".to_owned(), messages::string(code))]);
            if !field.is_empty() {
                parameters.insert("field".to_owned(), messages::string(field));
            }
            (message, wire::ModelInferResponse { model_name, id, parameters, ..Default::default() })
        }
    };
    let (name, value) = final_response();
    response.parameters.insert(name, value);
    wire::ModelStreamInferResponse { error_message, infer_response: Some(response) }
}

#[tonic::async_trait]
impl GrpcInferenceService for Service {
    async fn server_live(&self, _: Request<wire::ServerLiveRequest>) -> GrpcResult<wire::ServerLiveResponse> {
        Ok(Response::new(wire::ServerLiveResponse { live: true }))
    }

    async fn server_ready(&self, _: Request<wire::ServerReadyRequest>) -> GrpcResult<wire::ServerReadyResponse> {
        Ok(Response::new(wire::ServerReadyResponse { ready: self.0.ready().await.is_ok() }))
    }

    async fn model_ready(&self, request: Request<wire::ModelReadyRequest>) -> GrpcResult<wire::ModelReadyResponse> {
        let wire::ModelReadyRequest { name, version } = request.into_inner();
        Ok(Response::new(wire::ModelReadyResponse { ready: oip::is_ready(&self.0, &name, &version)? }))
    }

    async fn server_metadata(&self, _: Request<wire::ServerMetadataRequest>) -> GrpcResult<wire::ServerMetadataResponse> {
        let extensions = oip::EXTENSIONS.map(str::to_owned).to_vec();
        let (name, version) = (oip::NAME.to_owned(), oip::VERSION.to_owned());
        Ok(Response::new(wire::ServerMetadataResponse { name, version, extensions }))
    }

    async fn model_metadata(&self, request: Request<wire::ModelMetadataRequest>) -> GrpcResult<wire::ModelMetadataResponse> {
        let wire::ModelMetadataRequest { name, version } = request.into_inner();
        Ok(Response::new(metadata(oip::describe(&self.0, &name, &version).await?)))
    }

    async fn model_infer(&self, request: Request<wire::ModelInferRequest>) -> GrpcResult<wire::ModelInferResponse> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        Ok(Response::new(infer(&self.0, &caller, request.into_inner(), deadline).await?))
    }

    type ModelStreamInferStream = BoxStream<'static, Result<wire::ModelStreamInferResponse, Status>>;

    async fn model_stream_infer(
        &self,
        request: Request<Streaming<wire::ModelInferRequest>>,
    ) -> GrpcResult<Self::ModelStreamInferStream> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        let app = self.0.clone();
        let requests = stream::requests(app.clone(), request.into_inner());
        // One after another, because the slots of a sequence need not have steps.
        let responses = requests.then(move |request| {
            let (app, caller, counted) = (app.clone(), caller.clone(), count_message(&caller, &app));
            async move { Ok(infer_in_stream(&app, &caller, request?, counted?, deadline).await) }
        });
        Ok(Response::new(responses.boxed()))
    }

    async fn model_config(&self, request: Request<wire::ModelConfigRequest>) -> GrpcResult<wire::ModelConfigResponse> {
        let wire::ModelConfigRequest { name, version } = request.into_inner();
        let model = oip::describe(&self.0, &name, &version).await?;
        Ok(Response::new(wire::ModelConfigResponse { config: Some(config(model, self.0.sessions.ttl())) }))
    }

    async fn repository_index(
        &self,
        request: Request<wire::RepositoryIndexRequest>,
    ) -> GrpcResult<wire::RepositoryIndexResponse> {
        let wire::RepositoryIndexRequest { repository_name, ready } = request.into_inner();
        let models = oip::index(&self.0, &repository_name, ready)?.into_iter().map(messages::entry).collect();
        Ok(Response::new(wire::RepositoryIndexResponse { models }))
    }

    async fn repository_model_load(
        &self,
        request: Request<wire::RepositoryModelLoadRequest>,
    ) -> GrpcResult<wire::RepositoryModelLoadResponse> {
        let wire::RepositoryModelLoadRequest { repository_name, model_name, parameters } = request.into_inner();
        let parameters: Vec<&str> = parameters.keys().map(String::as_str).collect();
        oip::load(&self.0, &repository_name, &model_name, &parameters).await?;
        Ok(Response::new(wire::RepositoryModelLoadResponse {}))
    }

    async fn repository_model_unload(
        &self,
        request: Request<wire::RepositoryModelUnloadRequest>,
    ) -> GrpcResult<wire::RepositoryModelUnloadResponse> {
        let wire::RepositoryModelUnloadRequest { repository_name, model_name, parameters } = request.into_inner();
        let parameters: Vec<&str> = parameters.keys().map(String::as_str).collect();
        oip::unload(&self.0, &repository_name, &model_name, &parameters).await?;
        Ok(Response::new(wire::RepositoryModelUnloadResponse {}))
    }

    async fn model_statistics(
        &self,
        request: Request<wire::ModelStatisticsRequest>,
    ) -> GrpcResult<wire::ModelStatisticsResponse> {
        let wire::ModelStatisticsRequest { name, version } = request.into_inner();
        let model_stats = oip::statistics(&self.0, &name, &version)?.into_iter().map(tools::statistics).collect();
        Ok(Response::new(wire::ModelStatisticsResponse { model_stats }))
    }

    async fn trace_setting(&self, request: Request<wire::TraceSettingRequest>) -> GrpcResult<wire::TraceSettingResponse> {
        let wire::TraceSettingRequest { settings, model_name } = request.into_inner();
        oip::check_trace_settings(&self.0, &model_name, &tools::wanted_traces(settings))?;
        Ok(Response::new(tools::traces()))
    }

    async fn log_settings(&self, request: Request<wire::LogSettingsRequest>) -> GrpcResult<wire::LogSettingsResponse> {
        oip::check_log_settings(&tools::wanted_logs(request.into_inner().settings))?;
        Ok(Response::new(tools::logs()))
    }

    async fn system_shared_memory_status(
        &self,
        request: Request<wire::SystemSharedMemoryStatusRequest>,
    ) -> GrpcResult<wire::SystemSharedMemoryStatusResponse> {
        oip::shared_memory::status(&request.into_inner().name)?;
        Ok(Response::new(wire::SystemSharedMemoryStatusResponse::default()))
    }

    async fn system_shared_memory_register(
        &self,
        request: Request<wire::SystemSharedMemoryRegisterRequest>,
    ) -> GrpcResult<wire::SystemSharedMemoryRegisterResponse> {
        oip::shared_memory::register(&request.into_inner().name)?;
        Ok(Response::new(wire::SystemSharedMemoryRegisterResponse {}))
    }

    async fn system_shared_memory_unregister(
        &self,
        _: Request<wire::SystemSharedMemoryUnregisterRequest>,
    ) -> GrpcResult<wire::SystemSharedMemoryUnregisterResponse> {
        Ok(Response::new(wire::SystemSharedMemoryUnregisterResponse {}))
    }

    async fn cuda_shared_memory_status(
        &self,
        request: Request<wire::CudaSharedMemoryStatusRequest>,
    ) -> GrpcResult<wire::CudaSharedMemoryStatusResponse> {
        oip::shared_memory::status(&request.into_inner().name)?;
        Ok(Response::new(wire::CudaSharedMemoryStatusResponse::default()))
    }

    async fn cuda_shared_memory_register(
        &self,
        request: Request<wire::CudaSharedMemoryRegisterRequest>,
    ) -> GrpcResult<wire::CudaSharedMemoryRegisterResponse> {
        oip::shared_memory::register(&request.into_inner().name)?;
        Ok(Response::new(wire::CudaSharedMemoryRegisterResponse {}))
    }

    async fn cuda_shared_memory_unregister(
        &self,
        _: Request<wire::CudaSharedMemoryUnregisterRequest>,
    ) -> GrpcResult<wire::CudaSharedMemoryUnregisterResponse> {
        Ok(Response::new(wire::CudaSharedMemoryUnregisterResponse {}))
    }
}
