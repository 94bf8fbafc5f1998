//! The hostile clients, each at an address of its own.

mod load;
mod protocol;

use std::collections::BTreeMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// What the hostile clients know of the server.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Target {
    pub grpc: SocketAddr,
    pub http: SocketAddr,
    /// A valid API key, of another caller than the well-behaved one.
    pub key: String,
}

#[derive(Clone, Copy, Debug)]
enum Client {
    /// gRPC messages of 16 MiB, announced on many streams, of which one byte arrives.
    AnnouncedMessages,
    /// The same with bodies of REST.
    AnnouncedBodies,
    /// Hundreds of connections that only answer pings.
    IdleConnections,
    /// Streams that are reset as soon as they begin.
    RapidReset,
    /// Header blocks without end.
    Continuation,
    /// Connections that ask and do not read.
    SlowReaders,
    /// Random bytes, and random frames.
    Garbage,
    /// Bodies that arrive byte by byte.
    Drips,
    /// Headers of megabytes.
    HugeHeaders,
    /// 1024 UAVs and 1000 users, at full speed.
    LargeFleets,
    /// 1000 UAVs and 10 000 users who all detect hundreds of others.
    DenseScenes,
    /// An `ActStream` that does not wait.
    Pipelining,
    /// Sessions of large fleets, opened and left.
    SessionFlood,
    /// Requests without a key and with wrong keys.
    WithoutKey,
    /// Requests as the pages of other sites can send them.
    Browser,
}

const CLIENTS: [Client; 15] = [
    Client::AnnouncedMessages,
    Client::AnnouncedBodies,
    Client::IdleConnections,
    Client::RapidReset,
    Client::Continuation,
    Client::SlowReaders,
    Client::Garbage,
    Client::Drips,
    Client::HugeHeaders,
    Client::LargeFleets,
    Client::DenseScenes,
    Client::Pipelining,
    Client::SessionFlood,
    Client::WithoutKey,
    Client::Browser,
];

/// Number of attempts by client and result.
#[derive(Clone, Default)]
struct Counts(Arc<Mutex<BTreeMap<String, u64>>>);

impl Counts {
    fn add(&self, client: Client, result: &str) {
        *self.0.lock().unwrap().entry(format!("{client:?} {result}")).or_default() += 1;
    }
}

/// Runs all clients for this time.
pub async fn run(target: Target, time: Duration) {
    // The client of REST requires a TLS provider even for plain HTTP.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let only = std::env::var("QEDGIX_ABUSE_ONLY").ok();
    let chosen = |client: &Client| only.as_ref().is_none_or(|only| only.split(',').any(|name| name == format!("{client:?}")));
    let (counts, end) = (Counts::default(), Instant::now() + time);
    let mut clients = tokio::task::JoinSet::new();
    for (number, client) in CLIENTS.into_iter().enumerate().filter(|(_, client)| chosen(client)) {
        let attacker =
            Attacker { client, target: target.clone(), from: Ipv4Addr::new(127, 0, 1, number as u8), counts: counts.clone() };
        clients.spawn(async move {
            let mut round = 0;
            while Instant::now() < end {
                let left = end.saturating_duration_since(Instant::now());
                // What is in flight at the end is dropped, as by a client that is killed.
                let Ok(result) = tokio::time::timeout(left, attacker.attempt(round)).await else { break };
                attacker.counts.add(client, if result.is_ok() { "attempts" } else { "attempts that the server ended" });
                if result.is_err() {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                round += 1;
            }
        });
    }
    clients.join_all().await;
    for (what, count) in counts.0.lock().unwrap().iter() {
        println!("{count:>10}  {what}");
    }
}

/// One hostile client.
struct Attacker {
    client: Client,
    target: Target,
    from: Ipv4Addr,
    counts: Counts,
}

impl Attacker {
    /// One attempt; an error if the server has closed a connection or takes no more.
    async fn attempt(&self, round: u64) -> io::Result<()> {
        match self.client {
            Client::AnnouncedMessages => self.announce_messages(round).await,
            Client::AnnouncedBodies => self.announce_bodies(round).await,
            Client::IdleConnections => self.hold_idle_connections().await,
            Client::RapidReset => self.reset_rapidly(round).await,
            Client::Continuation => self.continue_headers().await,
            Client::SlowReaders => self.read_slowly().await,
            Client::Garbage => self.send_garbage(round).await,
            Client::Drips => self.drip().await,
            Client::HugeHeaders => self.send_huge_headers(round).await,
            Client::LargeFleets => self.fly_large_fleets().await,
            Client::DenseScenes => self.fly_dense_scenes(round).await,
            Client::Pipelining => self.pipeline().await,
            Client::SessionFlood => self.open_sessions(round).await,
            Client::WithoutKey => self.call_without_key(round).await,
            Client::Browser => self.command_from_a_page(round).await,
        }
    }

    /// The key in every other round.
    fn key(&self, round: u64) -> Option<&str> {
        round.is_multiple_of(2).then_some(self.target.key.as_str())
    }
}
