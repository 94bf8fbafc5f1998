//! Connections that are idle, old or too many.

use std::time::Duration;

use tokio::net::TcpSocket;

use super::*;

/// Lets time pass in steps until `condition` holds.
async fn pass(server: &Server, seconds: u64, mut condition: impl FnMut() -> bool) {
    with_timeout(async {
        while !condition() {
            server.advance(seconds);
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
}

async fn with_short_ticks() -> Server {
    Server::with(|config| {
        (config.read_timeout, config.connection_idle) = (Duration::from_secs(1), Duration::from_secs(1000));
        (config.connection_age, config.connection_grace) = (Duration::from_secs(100_000), Duration::from_secs(5000));
    })
    .await
}

#[tokio::test]
async fn a_connection_without_requests_is_closed_although_it_answers_pings() {
    let server = with_short_ticks().await;
    let mut raw = Raw::connect(&server).await;
    assert_eq!(raw.unary(ACT, framed(&slot())).await.0.code(), Code::Ok);
    pass(&server, 100, || raw.connection.is_finished()).await;
    with_timeout(raw.connection).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_connection_with_an_open_stream_stays_until_it_is_old_and_its_grace_is_over() {
    let server = with_short_ticks().await;
    let mut raw = Raw::connect(&server).await;
    let (response, mut stream) = raw.call(ACT_STREAM).await;
    let mut body = with_timeout(response).await.unwrap().into_body();
    let mut act = async || {
        stream.send_data(framed(&slot()), false).unwrap();
        let data = with_timeout(body.data()).await.unwrap()?;
        body.flow_control().release_capacity(data.len())?;
        Ok::<_, h2::Error>(())
    };
    // Many idle times pass.
    for _ in 0..20 {
        server.advance(2000);
        act().await.unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(!raw.connection.is_finished());
    // The age passes: the server wants no new streams, and the open one continues until the grace is over.
    server.advance(80_000);
    let mut client = raw.client.clone();
    with_timeout(async {
        loop {
            let request = Request::post(format!("http://x{ACT}")).header("content-type", "application/grpc").body(()).unwrap();
            match client.ready().await {
                Ok(ready) => client = ready,
                Err(_) => break,
            }
            match client.send_request(request, true) {
                Ok((response, _)) => drop(response.await),
                Err(_) => break,
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    act().await.unwrap();
    pass(&server, 1000, || raw.connection.is_finished()).await;
}

#[tokio::test]
async fn one_peer_cannot_take_all_connections() {
    let server = Server::with(|config| config.max_connections_per_peer = 2).await;
    let mut greedy = [server.grpc().await, server.grpc().await];
    for client in &mut greedy {
        client.act(slot()).await.unwrap();
    }
    // The peer has its probes, and nothing else.
    assert_eq!(reqwest::get(server.url("/readyz")).await.unwrap().status(), 200);
    assert_eq!(reqwest::get(server.url("/v1/policies")).await.unwrap().status(), 503);
    // Another peer is served.
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let socket = socket.connect(server.endpoints.grpc).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    let mut other = Raw { client, connection: tokio::spawn(connection) };
    assert_eq!(other.unary(ACT, framed(&slot())).await.0.code(), Code::Ok);
}
