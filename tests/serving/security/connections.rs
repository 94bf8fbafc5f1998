//! Limits on connections: too many, silent, or interrupted ones.

use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::super::harness::*;
use super::tls;

/// Waits until the server closes this connection and returns what it sent.
async fn closed(mut stream: TcpStream) -> Vec<u8> {
    let mut said = Vec::new();
    // A reset counts as closed.
    let _ = with_timeout(stream.read_to_end(&mut said)).await;
    said
}

async fn after(address: std::net::SocketAddr, bytes: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(bytes).await.unwrap();
    stream
}

async fn live(server: &Server) -> bool {
    reqwest::get(server.url("/livez")).await.is_ok_and(|answer| answer.status() == 200)
}

#[tokio::test]
async fn the_connection_limit_covers_both_addresses() {
    let server = Server::with(|config| config.max_connections = 3).await;
    let mut stream = after(server.endpoints.http, b"GET /livez HTTP/1.1\r\nhost: x\r\n\r\n").await;
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).await.unwrap();
    assert_eq!(&answer, b"HTTP/1.1 200");
    let mut fleets = [server.grpc().await, server.grpc().await];
    for fleet in &mut fleets {
        fleet.act(held_slot()).await.unwrap();
    }
    // Further connections serve only probes, on both addresses; open ones continue.
    assert!(live(&server).await);
    let answer = reqwest::get(server.url("/v1/policies")).await.unwrap();
    assert_eq!(answer.status(), 503);
    assert!(answer.headers().contains_key("retry-after"));
    let (code, reason, _) = refused(server.grpc().await.act(held_slot()).await);
    assert_eq!((code, reason.as_str()), (tonic::Code::ResourceExhausted, "overloaded"));
    for fleet in &mut fleets {
        fleet.act(held_slot()).await.unwrap();
    }
    // A closed connection frees its place.
    drop(stream);
    with_timeout(async {
        while !reqwest::get(server.url("/v1/policies")).await.is_ok_and(|answer| answer.status() == 200) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    assert!(qedgix::telemetry::install_metrics().render().contains("qedgix_connections_refused_total"));
}

fn held_slot() -> qedgix::wire::v1::ActRequest {
    held("sweep", Bytes::new(), scene(2, 2, 0))
}

#[tokio::test]
async fn silent_connections_and_bodies_time_out() {
    let server = Server::with(|config| config.read_timeout = Duration::from_millis(200)).await;
    let preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    let (grpc, http) = (server.endpoints.grpc, server.endpoints.http);
    for (address, begin) in [(grpc, &b""[..]), (grpc, &preface[..20]), (http, b""), (http, b"GET /livez HTTP/1.1\r\nhost: x\r\n")]
    {
        let said = closed(after(address, begin).await).await;
        assert!(!said.starts_with(b"HTTP/1.1 2"), "{said:?}");
    }
    // The timeout also applies between two requests of an HTTP/1 connection.
    let said = closed(after(http, b"GET /livez HTTP/1.1\r\nhost: x\r\n\r\n").await).await;
    assert!(said.starts_with(b"HTTP/1.1 200 OK"), "{said:?}");
    // An incomplete body is an error of the caller.
    let head = b"POST /v1/act HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: 100\r\n\r\n{\"polic";
    let said = String::from_utf8(closed(after(http, head).await).await).unwrap();
    assert!(said.starts_with("HTTP/1.1 400 "), "{said}");
    // After the preface, a gRPC connection may be silent for longer, because it answers pings.
    let mut client = server.grpc().await;
    client.act(held_slot()).await.unwrap();
    tokio::time::sleep(Duration::from_millis(500)).await;
    let socket = client.act(held_slot()).await;
    assert!(socket.is_ok(), "{socket:?}");
}

#[tokio::test]
async fn slow_handshakes_time_out_and_delay_no_other_connection() {
    let (dir, authority) = (tempfile::tempdir().unwrap(), tls::Authority::new("ours"));
    let files = tls::write(dir.path(), &authority.issue(), None);
    let server = Server::with(|config| (config.tls, config.read_timeout) = (Some(files), Duration::from_secs(5))).await;
    let mut silent = Vec::new();
    for _ in 0..50 {
        silent.push(after(server.endpoints.grpc, b"").await);
        silent.push(after(server.endpoints.http, &[0x16, 3, 1, 2]).await);
    }
    let caller = tls::caller(&authority, None);
    let url = format!("https://{}/livez", server.endpoints.http);
    assert_eq!(tls::get(&caller, false, &url).await.unwrap().0, 200);
    assert!(tls::policies(tls::channel(&caller, server.endpoints.grpc).await.unwrap()).await.is_ok());
    for stream in silent {
        closed(stream).await;
    }
}

#[tokio::test]
async fn shutdown_does_not_wait_for_handshakes() {
    let (dir, authority) = (tempfile::tempdir().unwrap(), tls::Authority::new("ours"));
    let files = tls::write(dir.path(), &authority.issue(), None);
    let mut server = Server::with(|config| (config.tls, config.read_timeout) = (Some(files), Duration::from_secs(3600))).await;
    let silent = after(server.endpoints.grpc, b"").await;
    let idle = tls::channel(&tls::caller(&authority, None), server.endpoints.grpc).await.unwrap();
    server.begin_stop();
    with_timeout(server.stopped()).await;
    closed(silent).await;
    assert!(tls::policies(idle).await.is_err());
}

#[tokio::test]
async fn streams_per_connection_are_limited() {
    for streams in [1024, 7] {
        let server = Server::with(|config| config.max_streams = streams).await;
        let socket = TcpStream::connect(server.endpoints.grpc).await.unwrap();
        let (client, connection) = h2::client::handshake(socket).await.unwrap();
        tokio::spawn(connection);
        let get = axum::http::Request::get("http://x/").body(()).unwrap();
        let mut client = client.ready().await.unwrap();
        // The server sends its settings before the response.
        let _ = with_timeout(client.send_request(get, true).unwrap().0).await;
        assert_eq!(client.current_max_send_streams(), streams as usize);
    }
}
