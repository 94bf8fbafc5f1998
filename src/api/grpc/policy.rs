//! `qedgix.v1.PolicyService`.

use std::sync::Arc;
use std::time::Instant;

use futures::future::join_all;
use futures::stream::{BoxStream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

use super::{deadline, stream};
use crate::api::auth::{caller, count_message};
use crate::api::convert::request::open_session;
use crate::api::convert::response::{Wanted, act_response};
use crate::api::convert::{decentral, flight};
use crate::api::errors::act_error;
use crate::invalid::in_range;
use crate::service::keys::Caller;
use crate::service::{App, Error, PageRequest, act, decentral as alone, policies, sessions};
use crate::serving::PolicySpec;
use crate::wire::v1;
use crate::wire::v1::policy_service_server::{PolicyService, PolicyServiceServer};

/// The service.
pub fn service(app: Arc<App>) -> PolicyServiceServer<impl PolicyService> {
    PolicyServiceServer::new(Handlers(app))
}

/// Maximum number of requests in one `ActBatch`.
const MAX_BATCH: usize = 1024;
/// Requests of one `ActStream` that are processed concurrently. Flow control delays further ones.
const MAX_IN_FLIGHT: usize = 64;

struct Handlers(Arc<App>);

/// Handles one `ActRequest` of any method.
async fn act_one(
    app: &App,
    caller: &Caller,
    request: v1::ActRequest,
    deadline: Option<Instant>,
) -> Result<v1::ActResponse, Error> {
    let (q_values, velocity, waypoint) = (request.return_q_values, request.return_velocity, request.return_waypoint);
    let (wanted, cost) = (Wanted { q_values, velocity, waypoint }, decoding_cost(&request));
    let decode = || act::Request::try_from(request);
    let request = act::decode(app, caller, cost, deadline, decode).await??;
    Ok(act_response(act::act(app, caller, request, deadline).await?, wanted))
}

/// Estimated cost of converting the request.
fn decoding_cost(request: &v1::ActRequest) -> usize {
    use v1::act_request::Observation;
    match &request.observation {
        Some(Observation::Graph(v1::Graph { nodes })) => {
            act::decoding_cost(nodes.len(), nodes.iter().map(|node| node.detections.len()).sum())
        }
        Some(Observation::Scene(scene)) => act::decoding_cost(scene.uavs.len() + scene.users.len(), 0),
        None => 0,
    }
}

/// The result of one request in a batch or stream.
fn act_result(response: Result<v1::ActResponse, Error>) -> v1::ActResult {
    use v1::act_result::Result::{Error, Response};
    v1::ActResult { result: Some(response.map_or_else(|error| Error(act_error(&error)), Response)) }
}

#[tonic::async_trait]
impl PolicyService for Handlers {
    async fn act(&self, request: Request<v1::ActRequest>) -> Result<Response<v1::ActResponse>, Status> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        Ok(Response::new(act_one(&self.0, &caller, request.into_inner(), deadline).await?))
    }

    async fn act_batch(&self, request: Request<v1::ActBatchRequest>) -> Result<Response<v1::ActBatchResponse>, Status> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        let requests = request.into_inner().requests;
        in_range("requests", requests.len(), 1..=MAX_BATCH).map_err(Error::from)?;
        // The call itself counts as one request.
        caller.charge(requests.len() as u32 - 1, &self.0.clock);
        let responses = requests.into_iter().map(|request| act_one(&self.0, &caller, request, deadline));
        let results = join_all(responses).await.into_iter().map(act_result).collect();
        Ok(Response::new(v1::ActBatchResponse { results }))
    }

    type ActStreamStream = BoxStream<'static, Result<v1::ActResult, Status>>;

    async fn act_stream(&self, request: Request<Streaming<v1::ActRequest>>) -> Result<Response<Self::ActStreamStream>, Status> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        let app = self.0.clone();
        let requests = stream::requests(app.clone(), request.into_inner());
        let results = requests.map(move |request| {
            let (app, caller, counted) = (app.clone(), caller.clone(), count_message(&caller, &app));
            async move {
                Ok(act_result(match (request?, counted?) {
                    (request, Ok(())) => act_one(&app, &caller, request, deadline).await,
                    (_, Err(busy)) => Err(busy),
                }))
            }
        });
        Ok(Response::new(results.buffered(MAX_IN_FLIGHT).boxed()))
    }

    async fn encode(&self, request: Request<v1::EncodeRequest>) -> Result<Response<v1::EncodeResponse>, Status> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        let request = alone::EncodeRequest::try_from(request.into_inner()).map_err(Error::from)?;
        Ok(Response::new(alone::encode(&self.0, &caller, request, deadline).await?.into()))
    }

    async fn decide(&self, request: Request<v1::DecideRequest>) -> Result<Response<v1::DecideResponse>, Status> {
        let (deadline, caller) = (deadline(request.extensions()), caller(request.extensions()));
        let request = request.into_inner();
        let (q_values, velocity, waypoint) = (request.return_q_values, request.return_velocity, request.return_waypoint);
        let request = alone::DecideRequest::try_from(request).map_err(Error::from)?;
        let decided = alone::decide(&self.0, &caller, request, deadline).await?;
        Ok(Response::new(decentral::decide_response(decided, Wanted { q_values, velocity, waypoint })))
    }

    async fn open_session(&self, request: Request<v1::OpenSessionRequest>) -> Result<Response<v1::Session>, Status> {
        let caller = caller(request.extensions());
        let v1::OpenSessionRequest { policy, session_id, run_id, seed, symmetric, frame, world, constraints } =
            request.into_inner();
        let flight = flight::fields(frame, world, symmetric, constraints).map_err(Error::from)?;
        let (policy, options) = open_session(&policy, session_id, run_id, seed, flight).map_err(Error::from)?;
        Ok(Response::new(sessions::open(&self.0, &caller, &policy, options).await?.into()))
    }

    async fn get_session(&self, request: Request<v1::GetSessionRequest>) -> Result<Response<v1::Session>, Status> {
        let caller = caller(request.extensions());
        Ok(Response::new(sessions::get(&self.0, &caller, &request.into_inner().session_id)?.into()))
    }

    async fn list_sessions(
        &self,
        request: Request<v1::ListSessionsRequest>,
    ) -> Result<Response<v1::ListSessionsResponse>, Status> {
        let caller = caller(request.extensions());
        let v1::ListSessionsRequest { page_size, page_token } = request.into_inner();
        let page = sessions::list(&self.0, &caller, &PageRequest { size: page_size, token: page_token })?.map(Into::into);
        Ok(Response::new(v1::ListSessionsResponse { sessions: page.items, next_page_token: page.next_token }))
    }

    async fn close_session(&self, request: Request<v1::CloseSessionRequest>) -> Result<Response<v1::Session>, Status> {
        let caller = caller(request.extensions());
        Ok(Response::new(sessions::close(&self.0, &caller, &request.into_inner().session_id).await?.into()))
    }

    async fn list_policies(
        &self,
        request: Request<v1::ListPoliciesRequest>,
    ) -> Result<Response<v1::ListPoliciesResponse>, Status> {
        let v1::ListPoliciesRequest { page_size, page_token } = request.into_inner();
        let page = policies::list(&self.0, &PageRequest { size: page_size, token: page_token }).await?.map(Into::into);
        Ok(Response::new(v1::ListPoliciesResponse { policies: page.items, next_page_token: page.next_token }))
    }

    async fn get_policy(&self, request: Request<v1::GetPolicyRequest>) -> Result<Response<v1::Policy>, Status> {
        let spec: PolicySpec = request.into_inner().policy.parse().map_err(Error::from)?;
        Ok(Response::new(policies::get(&self.0, &spec).await?.into()))
    }

    async fn list_policy_versions(
        &self,
        request: Request<v1::ListPolicyVersionsRequest>,
    ) -> Result<Response<v1::ListPolicyVersionsResponse>, Status> {
        let v1::ListPolicyVersionsRequest { name, page_size, page_token } = request.into_inner();
        let page = policies::versions(&self.0, &name, &PageRequest { size: page_size, token: page_token })?.map(Into::into);
        Ok(Response::new(v1::ListPolicyVersionsResponse { versions: page.items, next_page_token: page.next_token }))
    }

    async fn delete_policy_version(
        &self,
        request: Request<v1::DeletePolicyVersionRequest>,
    ) -> Result<Response<v1::DeletePolicyVersionResponse>, Status> {
        let v1::DeletePolicyVersionRequest { name, version } = request.into_inner();
        policies::delete(&self.0, &name, Some(version)).await?;
        Ok(Response::new(v1::DeletePolicyVersionResponse {}))
    }

    async fn delete_policy(
        &self,
        request: Request<v1::DeletePolicyRequest>,
    ) -> Result<Response<v1::DeletePolicyResponse>, Status> {
        policies::delete(&self.0, &request.into_inner().name, None).await?;
        Ok(Response::new(v1::DeletePolicyResponse {}))
    }
}
