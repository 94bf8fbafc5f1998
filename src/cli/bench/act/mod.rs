//! `qedgix bench act`: measures gRPC `Act` and compares it with a plain gRPC echo service.
//!
//! This file owns the flags and the order of rounds. `fleet` makes requests, `load` sends and times them, `echo` is the service
//! to compare with, `metrics` computes and formats the results.

mod echo;
mod fleet;
mod load;
mod metrics;

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::{Args, ValueEnum};
use prost::Message;
use serde_json::json;

use self::echo::Echo;
use self::fleet::{FleetConfig, SimulatedFleet};
use self::load::{LoadClient, LoadMode, code_name, round};
use self::metrics::{CallMetrics, CallSamples};
use crate::cli::act_client::{self, PolicyClient};
use crate::cli::connect::ConnectArgs;
use crate::cli::in_process_server::InProcessServer;
use crate::cli::output::{OutputError, outln};
use crate::cli::ports;
use crate::cli::serve::duration;
use crate::wire::v1;

pub(super) use self::echo::serve as echo;

/// Flags of `bench act`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  qedgix bench act                                         # one session, a server in this process
  qedgix bench act --sessions 64 --connections 4 --json
  qedgix bench act --sessions 16 --rate 2000 --duration 30s
  qedgix bench act --server 127.0.0.1:50051 --policy sweep --stream
  qedgix bench act --uavs 1000 --users 10000 --range 0.05 --observation graph")]
pub struct ActArgs {
    /// gRPC address of the server to measure [default: a temporary server in this process]
    #[arg(long, env = "QEDGIX_GRPC_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    #[command(flatten)]
    connect: ConnectArgs,
    /// Policy to run: NAME, NAME@ALIAS or NAME:VERSION
    #[arg(long, env = "QEDGIX_POLICY", default_value = "qedgix")]
    policy: String,
    /// Number of UAVs per fleet
    #[arg(long, env = "QEDGIX_UAVS", default_value_t = 3)]
    uavs: usize,
    /// Number of users per fleet
    #[arg(long, env = "QEDGIX_USERS", default_value_t = 5)]
    users: usize,
    /// Number of concurrent sessions; each has at most one Act in flight
    #[arg(long, env = "QEDGIX_SESSIONS", default_value_t = NonZeroU32::MIN)]
    sessions: NonZeroU32,
    /// Form of the observations
    #[arg(long, env = "QEDGIX_OBSERVATION", default_value = "scene", value_enum)]
    observation: ObservationForm,
    /// Detection range of the sessions' world, in sides of the square; the transmission range is 3/7 of it [default: the world of
    /// the policy]
    #[arg(long, env = "QEDGIX_RANGE")]
    range: Option<f64>,
    /// Open loop: Acts per second of all sessions together, with latencies from the time at which each is due [default: closed
    /// loop, each session sends when it has its previous response]
    #[arg(long, env = "QEDGIX_RATE", value_name = "PER_SECOND")]
    rate: Option<f64>,
    /// Measured time of Act and of the echo each: seconds, or a number with a unit such as 500ms or 2m; at most 10m
    #[arg(long, env = "QEDGIX_DURATION", default_value = "5s", value_parser = duration, value_name = "TIME")]
    duration: Duration,
    /// Time of the warm-up round before, at most 10m
    #[arg(long, env = "QEDGIX_WARMUP", default_value = "1s", value_parser = duration, value_name = "TIME")]
    warmup: Duration,
    /// Number of rounds that the measured time is divided into
    #[arg(long, env = "QEDGIX_ROUNDS", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rounds: u32,
    /// Number of connections that the sessions share
    #[arg(long, env = "QEDGIX_CONNECTIONS", default_value_t = NonZeroU32::MIN)]
    connections: NonZeroU32,
    /// Use ActStream with one stream per session, not Act
    #[arg(long, env = "QEDGIX_STREAM")]
    stream: bool,
    /// Print JSON instead of text
    #[arg(long, env = "QEDGIX_JSON")]
    json: bool,
}

/// Form of the observations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ObservationForm {
    /// Absolute positions of UAVs and users
    Scene,
    /// Detections of the UAVs
    Graph,
}

/// Maximum Acts per second.
const MAX_RATE: f64 = 1e6;
/// Maximum measured time, because every latency is kept in memory.
const MAX_TIME: Duration = Duration::from_secs(600);

impl ActArgs {
    /// Checks that the flags are in range.
    fn check(&self) -> anyhow::Result<()> {
        let max = 10_000;
        ensure!(self.sessions.get() <= max, "--sessions: {} is more than {max}", self.sessions);
        ensure!(
            self.connections <= self.sessions,
            "--connections: {} is more than --sessions, which is {}",
            self.connections,
            self.sessions
        );
        ensure!(!self.duration.is_zero(), "--duration: 0 s is too short");
        for (flag, time) in [("--duration", self.duration), ("--warmup", self.warmup)] {
            ensure!(time <= MAX_TIME, "{flag}: {time:?} is more than {MAX_TIME:?}");
        }
        if let Some(rate) = self.rate {
            ensure!(
                (1e-3..=MAX_RATE).contains(&rate),
                "--rate: {rate} is not valid; expected 0.001 to {MAX_RATE} Acts per second"
            );
        }
        if let Some(range) = self.range {
            ensure!((1e-4..=2.0).contains(&range), "--range: {range} is not valid; expected 0.0001 to 2 sides of the square");
        }
        Ok(())
    }
}

/// Runs the command.
///
/// # Errors
/// A flag is out of range, the server cannot be reached, or a call failed.
pub(super) async fn run(args: ActArgs) -> anyhow::Result<()> {
    args.check()?;
    let Some(address) = &args.server else {
        let dir = TemporaryDir(std::env::temp_dir().join(format!("qedgix-bench-{}", uuid::Uuid::now_v7())));
        let server = InProcessServer::start(&dir.0).await?;
        let measured = measure(&args, &server.grpc.to_string()).await;
        server.stop().await?;
        return measured;
    };
    ports::expect_grpc(address, &args.connect).await?;
    measure(&args, address).await
}

/// A directory that is removed when this is dropped.
struct TemporaryDir(PathBuf);

impl Drop for TemporaryDir {
    fn drop(&mut self) {
        // The system cleans up its temporary directory if this fails.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The measured service.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Target {
    Echo,
    Act,
}

async fn measure(args: &ActArgs, address: &str) -> anyhow::Result<()> {
    let mut server = act_client::connect(address, &args.connect).await?;
    let policy = server.get_policy(v1::GetPolicyRequest { policy: args.policy.clone() });
    let policy = policy.await.map_err(status_error).context("--policy")?.into_inner();
    let fleet = FleetConfig::new(args, &policy)?;
    let (request_bytes, response) = probe(&mut server, &fleet).await?;
    let echo = Echo::start(&response, args.server.is_some()).await?;

    let acts = clients(args, address, &fleet, true).await?;
    let echoes = clients(args, &echo.address.to_string(), &fleet, false).await?;
    let mut targets = [(Target::Echo, echoes, CallSamples::default()), (Target::Act, acts, CallSamples::default())];
    let mode = args.rate.map_or(LoadMode::ClosedLoop, LoadMode::OpenLoop);
    let each = args.duration / args.rounds;
    // Round 0 warms up and does not count.
    for number in 0..=args.rounds {
        let time = if number == 0 { args.warmup } else { each };
        for (_, clients, samples) in &mut targets {
            let sent = round(std::mem::take(clients), mode, time).await?;
            *clients = sent.0;
            if number > 0 {
                samples.append(sent.1);
            }
        }
        // The first target of a round affects the second (caches, clock rates), so they take turns.
        targets.reverse();
    }
    for (target, clients, _) in &mut targets {
        if *target == Target::Act {
            for client in std::mem::take(clients) {
                client.close().await;
            }
        }
    }
    drop(echo);
    let [one, other] = targets.map(|(target, _, samples)| (target, CallMetrics::new(samples)));
    let (act, echo) = if one.0 == Target::Act { (one.1, other.1) } else { (other.1, one.1) };
    print_report(args, (request_bytes, response.encoded_len()), &act, &echo)?;
    let (failed, all) = (act.failed() + echo.failed(), act.answers + echo.answers);
    if failed > 0 {
        bail!("{failed} of {} calls failed: {}", all + failed, metrics::format_errors(&[&act.errors, &echo.errors]));
    }
    ensure!(act.answers > 0 && echo.answers > 0, "no call was answered within --duration {:?}", args.duration);
    Ok(())
}

fn print_report(
    args: &ActArgs,
    (request, response): (usize, usize),
    act: &CallMetrics,
    echo: &CallMetrics,
) -> Result<(), OutputError> {
    if args.json {
        let document = json!({
            "policy": args.policy,
            "server": args.server,
            "uavs": args.uavs,
            "users": args.users,
            "observation": if args.observation == ObservationForm::Scene { "scene" } else { "graph" },
            "range": args.range,
            "sessions": args.sessions,
            "connections": args.connections,
            "stream": args.stream,
            "rate": args.rate,
            "duration_s": args.duration.as_secs_f64(),
            "rounds": args.rounds,
            "request_bytes": request,
            "response_bytes": response,
            "act": act.json(),
            "echo": echo.json(),
            "ratio": metrics::ratios(act, echo),
        });
        return outln!("{document}");
    }
    outln!(
        "policy {}, {} UAVs, {} users; {} session(s) on {} connection(s); requests of {request} bytes, responses of {response} bytes",
        args.policy,
        args.uavs,
        args.users,
        args.sessions,
        args.connections
    )?;
    outln!("{}", metrics::table(act, echo))
}

/// A gRPC status as an error message.
fn status_error(status: tonic::Status) -> anyhow::Error {
    anyhow::anyhow!("{}: {}", code_name(status.code()), status.message())
}

/// Runs one slot, which checks that the server accepts the fleet. Returns the size of the request and the response.
async fn probe(server: &mut PolicyClient, config: &FleetConfig) -> anyhow::Result<(usize, v1::ActResponse)> {
    let mut fleet = SimulatedFleet::new(config, session_id(), 0)?;
    let open = fleet.open_request(config);
    server.open_session(open).await.map_err(status_error)?;
    let request = fleet.request();
    let size = request.encoded_len();
    let response = server.act(request).await.map_err(status_error).with_context(|| format!("the first Act, of {size} bytes"))?;
    server.close_session(v1::CloseSessionRequest { session_id: fleet.session().to_owned() }).await.map_err(status_error)?;
    Ok((size, response.into_inner()))
}

fn session_id() -> String {
    format!("bench-{}", uuid::Uuid::now_v7())
}

/// Creates a client per session. For the server (`is_server`), opens the sessions; the echo service has none.
async fn clients(args: &ActArgs, address: &str, config: &FleetConfig, is_server: bool) -> anyhow::Result<Vec<LoadClient>> {
    // The echo service is local and requires neither API key nor TLS.
    let connect = if is_server { &args.connect } else { &ConnectArgs::default() };
    let mut connections = Vec::new();
    for _ in 0..args.connections.get() {
        connections.push(act_client::connect(address, connect).await?);
    }
    let mut clients = Vec::new();
    for i in 0..args.sessions.get() as usize {
        let mut server = connections[i % connections.len()].clone();
        let fleet = SimulatedFleet::new(config, session_id(), i as u64)?;
        if is_server {
            server.open_session(fleet.open_request(config)).await.map_err(status_error)?;
        }
        clients.push(LoadClient::new(server, fleet, (args.stream, is_server)).await.map_err(status_error)?);
    }
    Ok(clients)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        act: ActArgs,
    }

    #[test]
    fn errors_name_the_invalid_flag() {
        for (words, flag) in [
            (["--duration", "0"], "--duration"),
            (["--duration", "11m"], "--duration"),
            (["--warmup", "soon"], "--warmup"),
            (["--rate", "0"], "--rate"),
            (["--rate", "nan"], "--rate"),
            (["--range", "0"], "--range"),
            (["--sessions", "0"], "--sessions"),
            (["--sessions", "10001"], "--sessions"),
            (["--connections", "2"], "--connections"),
            (["--rounds", "0"], "--rounds"),
            (["--observation", "film"], "--observation"),
        ] {
            let refused = match Line::try_parse_from(std::iter::once("x").chain(words)) {
                Ok(line) => line.act.check().expect_err("must be refused").to_string(),
                Err(error) => error.to_string(),
            };
            assert!(refused.contains(flag), "{words:?}: {refused}");
        }
        Line::try_parse_from(["x"]).expect("no flag is needed").act.check().expect("the defaults are valid");
    }
}
