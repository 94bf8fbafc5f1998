//! `qedgix.v1.EnvironmentService`.

use std::sync::Arc;

use tonic::{Request, Response};

use super::GrpcResult;
use crate::api::auth::caller;
use crate::api::convert::environments::{create, environment_state, is_large};
use crate::api::offload;
use crate::service::{App, Error, environments};
use crate::serving::EnvironmentState;
use crate::wire::v1;
use crate::wire::v1::environment_service_server::{EnvironmentService, EnvironmentServiceServer};

/// The service.
pub fn service(app: Arc<App>) -> EnvironmentServiceServer<impl EnvironmentService> {
    EnvironmentServiceServer::new(Service(app))
}

struct Service(Arc<App>);

async fn respond(id: String, state: EnvironmentState) -> GrpcResult<v1::EnvironmentState> {
    Ok(Response::new(offload(is_large(&state), || environment_state(id, state)).await?))
}

#[tonic::async_trait]
impl EnvironmentService for Service {
    async fn create_environment(&self, request: Request<v1::CreateEnvironmentRequest>) -> GrpcResult<v1::Environment> {
        let caller = caller(request.extensions());
        let create = create(request.into_inner()).map_err(Error::from)?;
        Ok(Response::new(environments::create(&self.0, &caller, create).await?.into()))
    }

    async fn reset(&self, request: Request<v1::ResetRequest>) -> GrpcResult<v1::EnvironmentState> {
        let caller = caller(request.extensions());
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.environment_id);
        let state = environments::reset(&self.0, &caller, &id, request.into()).await?;
        respond(id, state).await
    }

    async fn step(&self, request: Request<v1::StepRequest>) -> GrpcResult<v1::EnvironmentState> {
        let caller = caller(request.extensions());
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.environment_id);
        let state = environments::step(&self.0, &caller, &id, request.into()).await?;
        respond(id, state).await
    }

    async fn get_environment(&self, request: Request<v1::GetEnvironmentRequest>) -> GrpcResult<v1::Environment> {
        let caller = caller(request.extensions());
        Ok(Response::new(environments::get(&self.0, &caller, &request.into_inner().environment_id)?.into()))
    }

    async fn delete_environment(&self, request: Request<v1::DeleteEnvironmentRequest>) -> GrpcResult<v1::Environment> {
        let caller = caller(request.extensions());
        Ok(Response::new(environments::delete(&self.0, &caller, &request.into_inner().environment_id).await?.into()))
    }
}
