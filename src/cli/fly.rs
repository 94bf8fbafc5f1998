//! Flies a served policy through gRPC `Act`, as an external simulator does: one session per episode, one scene per slot.

use anyhow::{Context, ensure};
use tonic::transport::Channel;

use crate::env::{EnvConfig, Episode, EpisodeMetrics};
use crate::wire::v1;
use crate::wire::v1::act_request::{Memory, Observation};
use crate::wire::v1::policy_service_client::PolicyServiceClient;

/// A policy server as a simulator sees it.
pub type Server = PolicyServiceClient<Channel>;

/// Connects to `address`, `HOST:PORT` or a URL.
///
/// # Errors
/// Nobody answers there.
pub async fn connect(address: &str) -> anyhow::Result<Server> {
    let url = if address.contains("://") { address.to_owned() } else { format!("http://{address}") };
    let endpoint = Channel::from_shared(url).context("not an address")?.tcp_nodelay(true);
    let channel = endpoint.connect().await.with_context(|| format!("cannot reach {address}"))?;
    Ok(PolicyServiceClient::new(channel))
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
