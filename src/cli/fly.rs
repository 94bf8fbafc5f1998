//! Flies a served policy through gRPC `Act`, as an external simulator does: one session per episode, one scene per slot.

use anyhow::{Context, ensure};
use axum::http::HeaderValue;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

use super::connect::ConnectArgs;
use crate::env::{EnvConfig, Episode, EpisodeMetrics};
use crate::wire::v1;
use crate::wire::v1::act_request::{Memory, Observation};
use crate::wire::v1::policy_service_client::PolicyServiceClient;

/// A policy server as a simulator sees it.
pub type Server = PolicyServiceClient<InterceptedService<Channel, Signature>>;

/// What every call shows: the API key, if there is one.
#[derive(Clone, Debug)]
pub struct Signature(Option<MetadataValue<Ascii>>);

impl Interceptor for Signature {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(authorization) = &self.0 {
            request.metadata_mut().insert("authorization", authorization.clone());
        }
        Ok(request)
    }
}

/// Connects to `address`, `HOST:PORT` or a URL.
///
/// # Errors
/// It is no address, the API key or a certificate cannot be used, nobody answers there.
pub async fn connect(address: &str, how: &ConnectArgs) -> anyhow::Result<Server> {
    let url = how.url(address)?;
    let sign = |value: HeaderValue| {
        MetadataValue::try_from(value.as_bytes()).map(|mut value| {
            value.set_sensitive(true);
            value
        })
    };
    let signature = how.authorization()?.map(sign).transpose()?;
    let endpoint = Endpoint::from(url.clone());
    let channel = endpoint.connect_with_connector(how.connector(&url, true)?).await;
    let channel = channel.with_context(|| format!("cannot reach {address}"))?;
    Ok(PolicyServiceClient::with_interceptor(channel, Signature(signature)))
}

/// Flies one episode per layout seed and returns the metrics of each.
///
/// # Errors
/// The server refuses a session or a step.
pub async fn episodes(server: &mut Server, policy: &str, env: &EnvConfig, seeds: &[u64]) -> anyhow::Result<Vec<EpisodeMetrics>> {
    let mut flown = Vec::with_capacity(seeds.len());
    for &seed in seeds {
        flown.push(episode(server, policy, env, seed).await.with_context(|| format!("policy {policy}, layout {seed}"))?);
    }
    Ok(flown)
}

async fn episode(server: &mut Server, policy: &str, env: &EnvConfig, seed: u64) -> anyhow::Result<EpisodeMetrics> {
    let open = v1::OpenSessionRequest { policy: policy.to_owned(), seed: Some(seed), ..Default::default() };
    let session_id = server.open_session(open).await?.into_inner().session_id;
    let mut world = Episode::new(env, seed)?;
    for step in 0..env.slots as u64 {
        let request = v1::ActRequest {
            observation: Some(Observation::Scene(scene(&world))),
            memory: Some(Memory::SessionId(session_id.clone())),
            step: Some(step),
            ..Default::default()
        };
        let answer = server.act(request).await?.into_inner();
        ensure!(answer.step == step, "asked for step {step}, got an answer for {}", answer.step);
        let headings: Vec<u8> = answer.actions.iter().map(|a| a.heading_index as u8).collect();
        world.step(&headings)?;
    }
    server.close_session(v1::CloseSessionRequest { session_id }).await?;
    Ok(world.metrics())
}

/// The world as a message.
fn scene(world: &Episode) -> v1::Scene {
    let uavs = world.uavs().into_iter().enumerate().map(|(i, [x, y])| v1::SceneUav { id: format!("uav-{i}"), x, y });
    let users = world.users().into_iter().zip(world.aoi()).enumerate();
    let users = users.map(|(i, ([x, y], aoi))| v1::SceneUser { id: format!("user-{i}"), x, y, aoi: f64::from(*aoi) });
    v1::Scene { uavs: uavs.collect(), users: users.collect() }
}
