//! `dm_env_rpc.v1.Environment`: hosted environments as worlds. A world is an environment of one copy; the agent of the stream that joins
//! it flies all its UAVs.

mod agent;
mod fleet;
mod properties;
mod tensors;

use std::sync::Arc;

use futures::stream::{BoxStream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

use self::agent::{Agent, Joined};
use super::{GrpcResult, stream};
use crate::api::auth::{caller, count_message};
use crate::service::App;
use crate::wire::dm::dm_env_rpc::v1 as wire;
use crate::wire::dm::dm_env_rpc::v1::environment_server::{Environment, EnvironmentServer};
use crate::wire::dm::google::rpc;
use wire::environment_response::Payload;

/// The service.
pub fn service(app: Arc<App>) -> EnvironmentServer<impl Environment> {
    EnvironmentServer::new(Service { app, joined: Joined::default() })
}

struct Service {
    app: Arc<App>,
    joined: Joined,
}

#[tonic::async_trait]
impl Environment for Service {
    type ProcessStream = BoxStream<'static, Result<wire::EnvironmentResponse, Status>>;

    async fn process(&self, request: Request<Streaming<wire::EnvironmentRequest>>) -> GrpcResult<Self::ProcessStream> {
        let (app, caller) = (self.app.clone(), caller(request.extensions()));
        let agent = Agent::new(app.clone(), caller.clone(), self.joined.clone());
        let requests = stream::requests(app.clone(), request.into_inner());
        // One after another. The agent leaves its world when the stream ends.
        let responses = futures::stream::unfold((Box::pin(requests), agent), move |(mut requests, mut agent)| {
            let (app, caller) = (app.clone(), caller.clone());
            async move {
                let answer = match (requests.next().await?, count_message(&caller, &app)) {
                    (Err(status), _) | (_, Err(status)) => return Some((Err(status), (requests, agent))),
                    (Ok(_), Ok(Err(busy))) => Err(busy),
                    (Ok(request), Ok(Ok(()))) => agent.answer(request).await,
                };
                // An error refuses the request, and the stream goes on.
                let payload = answer.unwrap_or_else(|error| {
                    let status = Status::from(error);
                    let (code, message) = (status.code() as i32, status.message().to_owned());
                    Payload::Error(rpc::Status { code, message, details: Vec::new() })
                });
                Some((Ok(wire::EnvironmentResponse { payload: Some(payload) }), (requests, agent)))
            }
        });
        Ok(Response::new(responses.boxed()))
    }
}
