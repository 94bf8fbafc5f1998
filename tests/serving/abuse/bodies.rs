//! Bodies that are announced and do not come, drip, are compressed or too many.

use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::*;

/// Whether the budget has room for a body of 600 KiB over REST.
async fn room(server: &Server) -> u16 {
    let body = format!("{{\"policy\": \"sweep\"{}", " ".repeat(600 << 10));
    let client = reqwest::Client::new();
    let response = client.post(server.url("/v1/act")).header("content-type", "application/json").body(body).send().await.unwrap();
    let status = response.status().as_u16();
    if status == 503 {
        assert!(response.headers().contains_key("retry-after"));
        let problem: serde_json::Value = response.json().await.unwrap();
        assert_eq!(problem["code"], "overloaded");
    }
    status
}

/// Sends `bytes`, or less if the server ends the call.
async fn send(stream: &mut SendStream<Bytes>, mut bytes: usize) {
    while bytes > 0 {
        stream.reserve_capacity(bytes);
        let Some(Ok(capacity)) = std::future::poll_fn(|context| stream.poll_capacity(context)).await else { return };
        let part = capacity.min(bytes);
        if stream.send_data(vec![0; part].into(), false).is_err() {
            return;
        }
        bytes -= part;
    }
}

#[tokio::test]
async fn a_body_that_is_announced_as_far_too_large_is_refused_by_its_header() {
    let server = Server::with(|config| config.read_timeout = Duration::from_secs(3600)).await;
    for (length, expect) in
        [("10000000000", ""), ("10000000000", "expect: 100-continue\r\n"), ("20000000", "expect: 100-continue\r\n")]
    {
        let mut socket = TcpStream::connect(server.endpoints.http).await.unwrap();
        let head = format!(
            "POST /v1/act HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n{expect}content-length: {length}\r\n\r\n"
        );
        socket.write_all(head.as_bytes()).await.unwrap();
        let mut answer = [0; 12];
        with_timeout(socket.read_exact(&mut answer)).await.unwrap();
        assert_eq!(&answer, b"HTTP/1.1 413", "{length} {expect:?}");
    }
}

#[tokio::test]
async fn the_budget_of_bytes_in_flight_covers_both_transports_and_is_given_back() {
    let server = Server::with(|config| config.max_inflight_bytes = 4 << 20).await;
    // Not JSON, which is found when the whole body is there.
    assert_eq!(room(&server).await, 400);
    let mut raw = Raw::connect(&server).await;
    let mut waiting = Vec::new();
    // What is only announced does not count.
    for _ in 0..20 {
        let (response, mut stream) = raw.call(ACT).await;
        stream.send_data(announced(8 << 20), false).unwrap();
        waiting.push((response, stream));
    }
    assert_eq!(room(&server).await, 400);
    // What arrives counts, until the budget is exhausted.
    let (responses, mut streams): (Vec<_>, Vec<_>) = waiting.into_iter().unzip();
    for stream in &mut streams {
        send(stream, 600 << 10).await;
    }
    let (refused, _, responses) = with_timeout(futures::future::select_all(responses)).await;
    let status = Status::from_header_map(refused.unwrap().headers()).unwrap();
    assert_status(status, Code::ResourceExhausted, "overloaded");
    with_timeout(async {
        while room(&server).await != 503 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    // Small requests and probes get in.
    server.grpc().await.act(slot()).await.unwrap();
    assert!(reqwest::get(server.url("/livez")).await.unwrap().status().is_success());
    drop((responses, streams, raw));
    with_timeout(async {
        while room(&server).await != 400 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

#[tokio::test]
async fn probes_and_unknown_methods_accept_small_messages_only() {
    let server = Server::start().await;
    let mut raw = Raw::connect(&server).await;
    for path in ["/grpc.health.v1.Health/Check", "/grpc.health.v1.Health/Watch", "/inference.GRPCInferenceService/ServerLive"] {
        let (response, mut stream) = raw.call(path).await;
        stream.send_data(announced(8 << 10), false).unwrap();
        assert_status(complete(response).await.0, Code::ResourceExhausted, "too_large");
    }
    // Reflection ends without an error of its own.
    let (response, mut stream) = raw.call("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo").await;
    stream.send_data(announced(8 << 10), false).unwrap();
    complete(response).await;
    // Over REST, probes have no body: the response does not wait for one.
    let mut socket = TcpStream::connect(server.endpoints.http).await.unwrap();
    socket.write_all(b"GET /livez HTTP/1.1\r\nhost: x\r\ncontent-length: 16777216\r\n\r\n{").await.unwrap();
    let mut answer = [0; 12];
    with_timeout(socket.read_exact(&mut answer)).await.unwrap();
    assert_eq!(&answer, b"HTTP/1.1 200");
}

#[tokio::test]
async fn a_message_that_does_not_come_is_an_error_and_a_silent_stream_is_not() {
    let server = Server::with(|config| config.read_timeout = Duration::from_secs(1)).await;
    let mut raw = Raw::connect(&server).await;
    let (silent, mut silent_stream) = raw.call(ACT_STREAM).await;
    silent_stream.send_data(framed(&slot()), false).unwrap();
    let mut silent = with_timeout(silent).await.unwrap().into_body();
    let first = with_timeout(silent.data()).await.unwrap().unwrap();
    let (unary, mut unary_stream) = raw.call(ACT).await;
    unary_stream.send_data(announced(1000), false).unwrap();
    let (stream, mut stream_stream) = raw.call(ACT_STREAM).await;
    stream_stream.send_data(announced(1000), false).unwrap();
    // Time passes until the server has seen the messages incomplete and late.
    let mut ended = Box::pin(async { (complete(unary).await.0, complete(stream).await.0) });
    let (unary, stream) = loop {
        server.advance(10);
        tokio::select! {
            ended = &mut ended => break ended,
            () = tokio::time::sleep(Duration::from_millis(20)) => {}
        }
    };
    for status in [unary, stream] {
        assert_invalid::<()>(Err(status), "message", "an incomplete message");
    }
    silent_stream.send_data(framed(&slot()), true).unwrap();
    silent.flow_control().release_capacity(first.len()).unwrap();
    assert!(!read(&mut silent).await.is_empty());
}

#[tokio::test]
async fn compressed_bodies_are_refused_on_both_transports() {
    let server = Server::start().await;
    // The Open Inference Protocol reads gzip and deflate.
    let cases = [
        ("/v1/act", &["gzip", "deflate", "identity, br", "unknown"][..]),
        ("/v2/models/sweep/infer", &["br", "identity, br", "gzip, gzip", "unknown"]),
        ("/v2/repository/index", &["gzip"]),
        ("/v1/jobs", &["gzip", "identity, br", "unknown"]),
    ];
    for (path, encodings) in cases {
        for &encoding in encodings {
            let request = reqwest::Client::new().post(server.url(path)).header("content-type", "application/json");
            let answer = request.header("content-encoding", encoding).body("{}").send().await.unwrap();
            assert_eq!(answer.status(), 415, "{path} {encoding}");
            let problem: serde_json::Value = answer.json().await.unwrap();
            assert_eq!(problem["code"], "unsupported_media_type");
            assert_eq!(problem["field"], "content-encoding");
        }
    }
    let mut raw = Raw::connect(&server).await;
    let (status, _) = raw.unary(ACT, Bytes::from_static(b"\x01\0\0\0\x01x")).await;
    assert_status(status, Code::Unimplemented, "unsupported_media_type");
    let mut request = tonic::Request::new(slot());
    request.metadata_mut().insert("grpc-encoding", "gzip".parse().unwrap());
    let status = server.grpc().await.act(request).await.unwrap_err();
    assert_status(status, Code::Unimplemented, "unsupported_media_type");
}
