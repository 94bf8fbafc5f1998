//! `GRPCInferenceService` of the Open Inference Protocol: decode, call one use case, encode.

mod messages;

use std::sync::Arc;
use std::time::Instant;

use futures::stream::{BoxStream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

use self::messages::{call, config, final_answer, metadata, reply};
use super::{deadline, stream};
use crate::api::errors::act_error;
use crate::api::oip;
use crate::service::{App, Error};
use crate::wire::oip as wire;
use crate::wire::oip::grpc_inference_service_server::{GrpcInferenceService, GrpcInferenceServiceServer};

/// The service.
pub fn service(app: Arc<App>) -> GrpcInferenceServiceServer<impl GrpcInferenceService> {
    GrpcInferenceServiceServer::new(Service(app))
}

struct Service(Arc<App>);

type Answer<T> = Result<Response<T>, Status>;

async fn answer(
    app: &App,
    request: wire::ModelInferRequest,
    deadline: Option<Instant>,
) -> Result<wire::ModelInferResponse, Error> {
    Ok(reply(oip::infer(app, call(request)?, deadline).await?))
}

/// One slot of a stream: answered or refused.
async fn answer_in_stream(
    app: &App,
    request: wire::ModelInferRequest,
    deadline: Option<Instant>,
) -> wire::ModelStreamInferResponse {
    let (model_name, id) = (request.model_name.clone(), request.id.clone());
    let (error_message, mut response) = match answer(app, request, deadline).await {
        Ok(response) => (String::new(), response),
        Err(error) => {
            let told = act_error(&error);
            let parameters = [("code".to_owned(), messages::text(told.code))].into();
            (told.message, wire::ModelInferResponse { model_name, id, parameters, ..Default::default() })
        }
    };
    let (name, value) = final_answer();
    response.parameters.insert(name, value);
    wire::ModelStreamInferResponse { error_message, infer_response: Some(response) }
}

#[tonic::async_trait]
impl GrpcInferenceService for Service {
    async fn server_live(&self, _: Request<wire::ServerLiveRequest>) -> Answer<wire::ServerLiveResponse> {
        Ok(Response::new(wire::ServerLiveResponse { live: true }))
    }

    async fn server_ready(&self, _: Request<wire::ServerReadyRequest>) -> Answer<wire::ServerReadyResponse> {
        Ok(Response::new(wire::ServerReadyResponse { ready: self.0.ready().await.is_ok() }))
    }

    async fn model_ready(&self, request: Request<wire::ModelReadyRequest>) -> Answer<wire::ModelReadyResponse> {
        let wire::ModelReadyRequest { name, version } = request.into_inner();
        Ok(Response::new(wire::ModelReadyResponse { ready: oip::is_ready(&self.0, &name, &version)? }))
    }

    async fn server_metadata(&self, _: Request<wire::ServerMetadataRequest>) -> Answer<wire::ServerMetadataResponse> {
        let extensions = oip::EXTENSIONS.map(str::to_owned).to_vec();
        let (name, version) = (oip::NAME.to_owned(), oip::VERSION.to_owned());
        Ok(Response::new(wire::ServerMetadataResponse { name, version, extensions }))
    }

    async fn model_metadata(&self, request: Request<wire::ModelMetadataRequest>) -> Answer<wire::ModelMetadataResponse> {
        let wire::ModelMetadataRequest { name, version } = request.into_inner();
        Ok(Response::new(metadata(oip::describe(&self.0, &name, &version)?)))
    }

    async fn model_infer(&self, request: Request<wire::ModelInferRequest>) -> Answer<wire::ModelInferResponse> {
        let deadline = deadline(request.extensions());
        Ok(Response::new(answer(&self.0, request.into_inner(), deadline).await?))
    }

    type ModelStreamInferStream = BoxStream<'static, Result<wire::ModelStreamInferResponse, Status>>;

    async fn model_stream_infer(
        &self,
        request: Request<Streaming<wire::ModelInferRequest>>,
    ) -> Answer<Self::ModelStreamInferStream> {
        let deadline = deadline(request.extensions());
        let app = self.0.clone();
        let requests = stream::requests(app.clone(), request.into_inner());
        // One after another: a sequence's slots follow each other without their steps being told.
        let answers = requests.then(move |request| {
            let app = app.clone();
            async move { Ok(answer_in_stream(&app, request?, deadline).await) }
        });
        Ok(Response::new(answers.boxed()))
    }

    async fn model_config(&self, request: Request<wire::ModelConfigRequest>) -> Answer<wire::ModelConfigResponse> {
        let wire::ModelConfigRequest { name, version } = request.into_inner();
        let model = oip::describe(&self.0, &name, &version)?;
        Ok(Response::new(wire::ModelConfigResponse { config: Some(config(model, self.0.sessions.ttl())) }))
    }

    async fn repository_index(&self, request: Request<wire::RepositoryIndexRequest>) -> Answer<wire::RepositoryIndexResponse> {
        let wire::RepositoryIndexRequest { repository_name, ready } = request.into_inner();
        let models = oip::index(&self.0, &repository_name, ready)?.into_iter().map(messages::entry).collect();
        Ok(Response::new(wire::RepositoryIndexResponse { models }))
    }

    async fn repository_model_load(
        &self,
        request: Request<wire::RepositoryModelLoadRequest>,
    ) -> Answer<wire::RepositoryModelLoadResponse> {
        let wire::RepositoryModelLoadRequest { repository_name, model_name, parameters } = request.into_inner();
        let parameters: Vec<&str> = parameters.keys().map(String::as_str).collect();
        oip::load(&self.0, &repository_name, &model_name, &parameters).await?;
        Ok(Response::new(wire::RepositoryModelLoadResponse {}))
    }

    async fn repository_model_unload(
        &self,
        request: Request<wire::RepositoryModelUnloadRequest>,
    ) -> Answer<wire::RepositoryModelUnloadResponse> {
        let wire::RepositoryModelUnloadRequest { repository_name, model_name, parameters } = request.into_inner();
        let parameters: Vec<&str> = parameters.keys().map(String::as_str).collect();
        oip::unload(&self.0, &repository_name, &model_name, &parameters).await?;
        Ok(Response::new(wire::RepositoryModelUnloadResponse {}))
    }
}
