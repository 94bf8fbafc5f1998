//! Callers that do not take their responses, or reset their requests.

use std::time::Duration;

use h2::Reason;

use super::*;

#[tokio::test]
async fn a_response_that_is_not_taken_is_given_up() {
    let server = Server::with(|config| config.write_timeout = Duration::from_secs(1)).await;
    let mut raw = Raw::with(&server, h2::client::Builder::new().initial_window_size(0)).await;
    let (response, mut stream) = raw.call(ACT).await;
    stream.send_data(framed(&slot()), true).unwrap();
    let mut body = with_timeout(response).await.unwrap().into_body();
    let mut ended = Box::pin(body.data());
    let error = loop {
        server.advance(10);
        tokio::select! {
            ended = &mut ended => break ended.unwrap().unwrap_err(),
            () = tokio::time::sleep(Duration::from_millis(20)) => {}
        }
    };
    assert_eq!(error.reason(), Some(Reason::CANCEL));
    // Only this stream ends.
    assert!(!raw.connection.is_finished());
}

#[tokio::test]
async fn requests_that_are_reset_at_once_harm_nobody_else() {
    let server = Server::start().await;
    let raw = Raw::connect(&server).await;
    for _ in 0..5000 {
        let Ok(mut client) = raw.client.clone().ready().await else { break };
        let request = Request::post(format!("http://x{ACT}")).header("content-type", "application/grpc").body(()).unwrap();
        let Ok((_, mut stream)) = client.send_request(request, false) else { break };
        stream.send_reset(Reason::CANCEL);
    }
    server.grpc().await.act(slot()).await.unwrap();
}

#[tokio::test]
async fn endless_headers_end_the_connection() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let server = Server::start().await;
    let mut socket = TcpStream::connect(server.endpoints.grpc).await.unwrap();
    socket.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.unwrap();
    // HEADERS without END_HEADERS, then CONTINUATION frames of 1 KiB without end.
    socket.write_all(b"\0\0\0\x01\0\0\0\0\x01").await.unwrap();
    let mut frame = b"\0\x04\0\x09\0\0\0\0\x01".to_vec();
    frame.extend([0x82; 1024]);
    let (mut reader, mut writer) = socket.into_split();
    let flood = tokio::spawn(async move { while writer.write_all(&frame).await.is_ok() {} });
    let mut said = Vec::new();
    let _ = with_timeout(reader.read_to_end(&mut said)).await;
    drop(reader);
    with_timeout(flood).await.unwrap();
    server.grpc().await.act(slot()).await.unwrap();
}
