//! `PolicyService`: decode, call one use case, encode.

use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::deadline;
use crate::api::convert::{request::open_session, response::act_response};
use crate::service::{App, Error, act, policies, sessions};
use crate::serving::PolicySpec;
use crate::wire::v1;
use crate::wire::v1::policy_service_server::{PolicyService, PolicyServiceServer};

/// The service.
pub fn service(app: Arc<App>) -> PolicyServiceServer<impl PolicyService> {
    PolicyServiceServer::new(Handlers(app))
}

struct Handlers(Arc<App>);

#[tonic::async_trait]
impl PolicyService for Handlers {
    async fn act(&self, request: Request<v1::ActRequest>) -> Result<Response<v1::ActResponse>, Status> {
        let deadline = deadline(request.extensions());
        let request = request.into_inner();
        let values = request.return_q_values;
        let request = act::Request::try_from(request).map_err(Error::from)?;
        let answer = act::act(&self.0, request, deadline).await?;
        Ok(Response::new(act_response(answer, values)))
    }

    async fn open_session(&self, request: Request<v1::OpenSessionRequest>) -> Result<Response<v1::Session>, Status> {
        let (policy, how) = open_session(request.into_inner()).map_err(Error::from)?;
        Ok(Response::new(sessions::open(&self.0, &policy, how).await?.into()))
    }

    async fn close_session(&self, request: Request<v1::CloseSessionRequest>) -> Result<Response<v1::Session>, Status> {
        Ok(Response::new(sessions::close(&self.0, &request.into_inner().session_id).await?.into()))
    }

    async fn list_policies(
        &self,
        request: Request<v1::ListPoliciesRequest>,
    ) -> Result<Response<v1::ListPoliciesResponse>, Status> {
        let request = request.into_inner();
        let (page, next) = policies::list(&self.0, request.page_size, &request.page_token)?;
        let policies = page.into_iter().map(Into::into).collect();
        Ok(Response::new(v1::ListPoliciesResponse { policies, next_page_token: next.unwrap_or_default() }))
    }

    async fn get_policy(&self, request: Request<v1::GetPolicyRequest>) -> Result<Response<v1::Policy>, Status> {
        let spec: PolicySpec = request.into_inner().policy.parse().map_err(Error::from)?;
        Ok(Response::new(policies::get(&self.0, &spec)?.into()))
    }
}
