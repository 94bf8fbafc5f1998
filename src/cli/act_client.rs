//! A client of gRPC `Act` that runs whole episodes, as an external simulator does: one session per episode, one scene per slot.

use anyhow::{Context, ensure};
use axum::http::HeaderValue;
use futures::{StreamExt, TryStreamExt, stream};
use indicatif::ProgressBar;
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

/// A client of `PolicyService` that sends the API key.
pub type PolicyClient = PolicyServiceClient<InterceptedService<Channel, ApiKeyInterceptor>>;

/// Adds the API key, if there is one, to every call.
#[derive(Clone, Debug)]
pub struct ApiKeyInterceptor(Option<MetadataValue<Ascii>>);

impl Interceptor for ApiKeyInterceptor {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(authorization) = &self.0 {
            request.metadata_mut().insert("authorization", authorization.clone());
        }
        Ok(request)
    }
}

/// Connects to `address`, which is `HOST:PORT` or a URL.
///
/// # Errors
/// The address, the API key or a certificate is invalid, or the server cannot be reached.
pub async fn connect(address: &str, args: &ConnectArgs) -> anyhow::Result<PolicyClient> {
    let url = args.url(address)?;
    let metadata = |value: HeaderValue| {
        MetadataValue::try_from(value.as_bytes()).map(|mut value| {
            value.set_sensitive(true);
            value
        })
    };
    let api_key = args.authorization(&url)?.map(metadata).transpose()?;
    let endpoint = Endpoint::from(url.clone());
    let channel = endpoint.connect_with_connector(args.connector(&url)?).await;
    let channel = channel.with_context(|| format!("cannot reach {address}"))?;
    Ok(PolicyServiceClient::with_interceptor(channel, ApiKeyInterceptor(api_key)))
}

/// Episodes that fly at the same time, each in a session of its own.
const AT_ONCE: usize = 16;

/// Runs one episode per layout seed and returns the metrics of each. Advances `bar` by one per episode.
///
/// # Errors
/// The server refuses a session or a step.
pub async fn run_episodes(
    server: &PolicyClient,
    policy: &str,
    env: &EnvConfig,
    seeds: &[u64],
    bar: &ProgressBar,
) -> anyhow::Result<Vec<EpisodeMetrics>> {
    let episodes = seeds.iter().map(|&seed| async move {
        let metrics = run_episode(server.clone(), policy, env, seed).await;
        bar.inc(1);
        metrics.with_context(|| format!("policy {policy}, layout {seed}"))
    });
    stream::iter(episodes).buffered(AT_ONCE).try_collect().await
}

async fn run_episode(mut server: PolicyClient, policy: &str, env: &EnvConfig, seed: u64) -> anyhow::Result<EpisodeMetrics> {
    let open = v1::OpenSessionRequest { policy: policy.to_owned(), seed: Some(seed), ..Default::default() };
    let session_id = server.open_session(open).await?.into_inner().session_id;
    let mut episode = Episode::new(env, seed)?;
    for step in 0..env.slots as u64 {
        let request = v1::ActRequest {
            observation: Some(Observation::Scene(scene(&episode))),
            memory: Some(Memory::SessionId(session_id.clone())),
            step: Some(step),
            ..Default::default()
        };
        let response = server.act(request).await?.into_inner();
        ensure!(response.step == step, "sent step {step}, received the response for step {}", response.step);
        let mut actions = response.actions.iter().map(|a| a.heading_index as u8);
        let flies = |i: usize| env.flies(i, episode.slot());
        let headings: Vec<u8> = (0..env.uavs).map(|i| if flies(i) { actions.next().unwrap_or(0) } else { 0 }).collect();
        episode.step(&headings)?;
    }
    server.close_session(v1::CloseSessionRequest { session_id }).await?;
    Ok(episode.metrics())
}

/// The scene of the current slot as a message: the UAVs that fly and the users that are there.
fn scene(episode: &Episode) -> v1::Scene {
    let (env, slot) = (episode.config(), episode.slot());
    let uavs = episode.uavs().into_iter().enumerate().filter(|(i, _)| env.flies(*i, slot));
    let uavs = uavs.map(|(i, [x, y])| v1::SceneUav { id: format!("uav-{i}"), x, y, ..Default::default() });
    let users = episode.users().into_iter().zip(episode.aoi()).enumerate().filter(|(j, _)| env.is_there(*j, slot));
    let users = users.map(|(j, ([x, y], aoi))| v1::SceneUser { id: format!("user-{j}"), x, y, aoi: f64::from(*aoi), z: None });
    v1::Scene { uavs: uavs.collect(), users: users.collect() }
}
