//! `qedgix bench act`: load for gRPC `Act`, beside a bare gRPC echo.
//!
//! This file owns the flags and the order of rounds; `world` makes requests, `load` sends and times them, `echo` is the
//! yardstick, `figures` what is told.

mod echo;
mod figures;
mod load;
mod world;

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::{Args, ValueEnum};
use prost::Message;
use serde_json::json;

use self::echo::Echo;
use self::figures::{Figures, Samples};
use self::load::{Client, Pace, round};
use self::world::{Setup, World};
use crate::cli::connect::ConnectArgs;
use crate::cli::fly;
use crate::cli::local::LocalServer;
use crate::cli::serve::duration;
use crate::wire::v1;

pub(super) use self::echo::serve as echo;

/// Flags of `bench act`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  qedgix bench act                                         # one session after another answer, a server in this process
  qedgix bench act --sessions 64 --connections 4 --json
  qedgix bench act --sessions 16 --rate 2000 --duration 30s
  qedgix bench act --server 127.0.0.1:50051 --policy sweep --stream
  qedgix bench act --uavs 1000 --users 10000 --range 0.05 --observation graph")]
pub struct ActArgs {
    /// Server to load [default: one in this process, on a free port with a temporary data directory]
    #[arg(long, env = "QEDGIX_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    #[command(flatten)]
    connect: ConnectArgs,
    /// Policy to fly: NAME, NAME@ALIAS or NAME:VERSION
    #[arg(long, env = "QEDGIX_POLICY", default_value = "qedgix")]
    policy: String,
    /// UAVs of each fleet
    #[arg(long, env = "QEDGIX_UAVS", default_value_t = 3)]
    uavs: usize,
    /// Users of each fleet
    #[arg(long, env = "QEDGIX_USERS", default_value_t = 5)]
    users: usize,
    /// Sessions at the same time; each has one Act in flight at most
    #[arg(long, env = "QEDGIX_SESSIONS", default_value_t = NonZeroU32::MIN)]
    sessions: NonZeroU32,
    /// What is sent
    #[arg(long, env = "QEDGIX_OBSERVATION", default_value = "scene", value_enum)]
    observation: Observation,
    /// How far nodes see, in sides of the square: lengths are scaled so that the policy's own range is this far [default: the
    /// policy's own range, unscaled]
    #[arg(long, env = "QEDGIX_RANGE")]
    range: Option<f64>,
    /// Acts per second of all sessions together, sent when they are due whether or not earlier ones are answered, and timed from
    /// then [default: each session sends when it has its last answer]
    #[arg(long, env = "QEDGIX_RATE", value_name = "PER_SECOND")]
    rate: Option<f64>,
    /// Time measured, of Act and of the echo each: seconds, or 500ms, 2m
    #[arg(long, env = "QEDGIX_DURATION", default_value = "5s", value_parser = duration)]
    duration: Duration,
    /// Time before that, likewise
    #[arg(long, env = "QEDGIX_WARMUP", default_value = "1s", value_parser = duration)]
    warmup: Duration,
    /// Rounds that the time is cut into
    #[arg(long, env = "QEDGIX_ROUNDS", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rounds: u32,
    /// Connections that the sessions share
    #[arg(long, env = "QEDGIX_CONNECTIONS", default_value_t = NonZeroU32::MIN)]
    connections: NonZeroU32,
    /// Use ActStream, one stream per session
    #[arg(long, env = "QEDGIX_STREAM")]
    stream: bool,
    /// Print JSON
    #[arg(long, env = "QEDGIX_JSON")]
    json: bool,
}

/// How a slot is described.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Observation {
    /// Absolute positions
    Scene,
    /// What UAVs detect
    Graph,
}

/// Most sessions, connections, and Acts per second.
const MOST: f64 = 1e6;
/// Longest measurement: every latency is kept.
const LONGEST: Duration = Duration::from_secs(600);

impl ActArgs {
    /// Refuses what cannot be measured.
    fn check(&self) -> anyhow::Result<()> {
        let most = 10_000;
        ensure!(self.sessions.get() <= most, "--sessions: {}, but at most {most}", self.sessions);
        ensure!(
            self.connections <= self.sessions,
            "--connections: {}, but there are {} sessions",
            self.connections,
            self.sessions
        );
        ensure!(!self.duration.is_zero(), "--duration: 0, but something has to be measured");
        for (flag, time) in [("--duration", self.duration), ("--warmup", self.warmup)] {
            ensure!(time <= LONGEST, "{flag}: {time:?}, but at most {LONGEST:?}");
        }
        if let Some(rate) = self.rate {
            ensure!((1e-3..=MOST).contains(&rate), "--rate: {rate}, but 0.001 to {MOST} Acts per second");
        }
        if let Some(range) = self.range {
            ensure!((1e-4..=2.0).contains(&range), "--range: {range}, but 0.0001 to 2 sides of the square");
        }
        Ok(())
    }
}

/// Runs the command.
///
/// # Errors
/// Flags that cannot be used, a server that cannot be reached, and any Act that was not answered.
pub(super) async fn run(args: ActArgs) -> anyhow::Result<()> {
    args.check()?;
    let Some(address) = &args.server else {
        let dir = Temporary(std::env::temp_dir().join(format!("qedgix-bench-{}", uuid::Uuid::now_v7())));
        let server = LocalServer::start(&dir.0).await?;
        let measured = measure(&args, &server.grpc.to_string()).await;
        server.stop().await?;
        return measured;
    };
    measure(&args, address).await
}

/// A directory that is removed with its contents.
struct Temporary(PathBuf);

impl Drop for Temporary {
    fn drop(&mut self) {
        // What is left is in the system's directory for that.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Who is measured.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Echo,
    Act,
}

async fn measure(args: &ActArgs, address: &str) -> anyhow::Result<()> {
    let mut server = fly::connect(address, &args.connect).await?;
    let policy = server.get_policy(v1::GetPolicyRequest { policy: args.policy.clone() });
    let policy = policy.await.map_err(told).context("--policy")?.into_inner();
    let setup = Setup::new(args, &policy)?;
    let (request, answer) = probe(&mut server, &setup).await?;
    let echo = Echo::start(&answer, args.server.is_some()).await?;

    let acts = clients(args, address, &setup, true).await?;
    let echoes = clients(args, &echo.address.to_string(), &setup, false).await?;
    let mut sides = [(Side::Echo, echoes, Samples::default()), (Side::Act, acts, Samples::default())];
    let pace = args.rate.map_or(Pace::Answers, Pace::Rate);
    let each = args.duration / args.rounds;
    // Round 0 warms up and does not count.
    for number in 0..=args.rounds {
        let time = if number == 0 { args.warmup } else { each };
        for (_, clients, samples) in &mut sides {
            let sent = round(std::mem::take(clients), pace, time).await?;
            *clients = sent.0;
            if number > 0 {
                samples.add(sent.1);
            }
        }
        // Whoever comes second finds the machine as the first left it; both do in turn.
        sides.reverse();
    }
    for (side, clients, _) in &mut sides {
        if *side == Side::Act {
            for client in std::mem::take(clients) {
                client.close().await;
            }
        }
    }
    drop(echo);
    let [one, other] = sides.map(|(side, _, samples)| (side, Figures::of(samples)));
    let (act, echo) = if one.0 == Side::Act { (one.1, other.1) } else { (other.1, one.1) };
    tell(args, (request, answer.encoded_len()), &act, &echo);
    let (failed, all) = (act.failed() + echo.failed(), act.answers + echo.answers);
    if failed > 0 {
        bail!("{failed} of {} calls failed: {}", all + failed, figures::list(&[&act.errors, &echo.errors]));
    }
    ensure!(act.answers > 0 && echo.answers > 0, "nothing was answered within --duration {:?}", args.duration);
    Ok(())
}

fn tell(args: &ActArgs, (request, response): (usize, usize), act: &Figures, echo: &Figures) {
    if args.json {
        let document = json!({
            "policy": args.policy,
            "server": args.server,
            "uavs": args.uavs,
            "users": args.users,
            "observation": if args.observation == Observation::Scene { "scene" } else { "graph" },
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
            "ratio": figures::ratios(act, echo),
        });
        println!("{document}");
        return;
    }
    println!(
        "policy {}, {} UAVs, {} users; {} session(s) on {} connection(s); {request} bytes asked, {response} answered",
        args.policy, args.uavs, args.users, args.sessions, args.connections
    );
    println!("{}", figures::table(act, echo));
}

/// A status in a line.
fn told(status: tonic::Status) -> anyhow::Error {
    anyhow::anyhow!("{}: {}", load::name(status.code()), status.message())
}

/// One slot, to know the sizes of messages and that this fleet can be flown at all: the request's size, and the answer.
async fn probe(server: &mut fly::Server, setup: &Setup) -> anyhow::Result<(usize, v1::ActResponse)> {
    let mut world = World::new(setup, session_id(), 0)?;
    let open = world.open(setup);
    server.open_session(open).await.map_err(told)?;
    let request = world.request();
    let size = request.encoded_len();
    let answer = server.act(request).await.map_err(told).with_context(|| format!("the first Act, of {size} bytes"))?;
    server.close_session(v1::CloseSessionRequest { session_id: world.session().to_owned() }).await.map_err(told)?;
    Ok((size, answer.into_inner()))
}

fn session_id() -> String {
    format!("bench-{}", uuid::Uuid::now_v7())
}

/// A client per session; `sessions` are opened where it is the server.
async fn clients(args: &ActArgs, address: &str, setup: &Setup, sessions: bool) -> anyhow::Result<Vec<Client>> {
    // The echo is on this machine and asks for nothing.
    let how = if sessions { &args.connect } else { &ConnectArgs::default() };
    let mut connections = Vec::new();
    for _ in 0..args.connections.get() {
        connections.push(fly::connect(address, how).await?);
    }
    let mut clients = Vec::new();
    for i in 0..args.sessions.get() as usize {
        let mut server = connections[i % connections.len()].clone();
        let world = World::new(setup, session_id(), i as u64)?;
        if sessions {
            server.open_session(world.open(setup)).await.map_err(told)?;
        }
        clients.push(Client::new(server, world, args.stream).await.map_err(told)?);
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
    fn wrong_flags_are_named() {
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
        Line::try_parse_from(["x"]).expect("no flag is needed").act.check().expect("defaults are fine");
    }
}
