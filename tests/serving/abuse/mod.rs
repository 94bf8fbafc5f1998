//! Callers that break the rules: they announce what they do not send, hold connections, or do not take their responses.

mod bodies;
mod connections;
mod pipelining;
mod responses;

use axum::http::Request;
use bytes::Bytes;
use h2::client::{ResponseFuture, SendRequest};
use h2::{RecvStream, SendStream};
use prost::Message;
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tonic::{Code, Status};

use super::harness::*;

const ACT: &str = "/qedgix.v1.PolicyService/Act";
const ACT_STREAM: &str = "/qedgix.v1.PolicyService/ActStream";

/// An HTTP/2 connection whose frames the test decides.
struct Raw {
    client: SendRequest<Bytes>,
    /// Ends with the connection.
    connection: JoinHandle<Result<(), h2::Error>>,
}

impl Raw {
    async fn connect(server: &Server) -> Self {
        Self::with(server, &h2::client::Builder::new()).await
    }

    async fn with(server: &Server, builder: &h2::client::Builder) -> Self {
        let socket = TcpStream::connect(server.endpoints.grpc).await.unwrap();
        let (client, connection) = builder.handshake(socket).await.unwrap();
        Self { client, connection: tokio::spawn(connection) }
    }

    /// Begins a call.
    async fn call(&mut self, path: &str) -> (ResponseFuture, SendStream<Bytes>) {
        let request =
            Request::post(format!("http://x{path}")).header("content-type", "application/grpc").header("te", "trailers");
        let mut client = self.client.clone().ready().await.unwrap();
        client.send_request(request.body(()).unwrap(), false).unwrap()
    }

    /// Sends one message and the end of the stream, and returns the status and the body.
    async fn unary(&mut self, path: &str, message: Bytes) -> (Status, Vec<u8>) {
        let (response, mut stream) = self.call(path).await;
        stream.send_data(message, true).unwrap();
        complete(response).await
    }
}

/// A message with its head.
fn framed(message: &impl Message) -> Bytes {
    let mut framed = vec![0];
    framed.extend((message.encoded_len() as u32).to_be_bytes());
    message.encode(&mut framed).unwrap();
    framed.into()
}

/// The head of a message that announces `length` bytes, and one byte of it.
fn announced(length: u32) -> Bytes {
    let mut head = vec![0];
    head.extend(length.to_be_bytes());
    head.push(0);
    head.into()
}

/// Reads a response to its end.
async fn complete(response: ResponseFuture) -> (Status, Vec<u8>) {
    let (head, mut body) = with_timeout(response).await.unwrap().into_parts();
    let data = read(&mut body).await;
    let trailers = with_timeout(body.trailers()).await.unwrap();
    let status = trailers.as_ref().and_then(Status::from_header_map).or_else(|| Status::from_header_map(&head.headers));
    (status.expect("a status"), data)
}

async fn read(body: &mut RecvStream) -> Vec<u8> {
    let mut data = Vec::new();
    while let Some(part) = with_timeout(body.data()).await {
        let part = part.unwrap();
        body.flow_control().release_capacity(part.len()).unwrap();
        data.extend(part);
    }
    data
}

/// Checks code and error code of a status.
#[track_caller]
fn assert_status(status: Status, code: Code, reason: &str) {
    let (grpc, found, _) = refused::<()>(Err(status));
    assert_eq!((grpc, found.as_str()), (code, reason));
}

fn slot() -> qedgix::wire::v1::ActRequest {
    held("sweep", Bytes::new(), scene(2, 2, 0))
}
