//! The yardstick: a gRPC service that decodes what `Act` is sent and answers what `Act` answered once, with the server's
//! transport settings and nothing else of it. Like the server measured it is part of this process, or another process.

use std::net::SocketAddr;
use std::process::Stdio;
use std::sync::Arc;

use anyhow::Context;
use futures::stream::{BoxStream, StreamExt};
use prost::Message;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpListener;
use tokio::process::{Child, Command};
use tokio::task::JoinHandle;
use tonic::transport::Server as Transport;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status, Streaming};

use crate::server::{KEEPALIVE, WINDOW};
use crate::wire::v1;
use crate::wire::v1::policy_service_server::{PolicyService, PolicyServiceServer};

/// Largest request, as large as any that a server may be told to take.
const LARGEST: usize = 1 << 30;

/// A running echo; it ends when this is dropped.
pub(super) struct Echo {
    /// Where it listens.
    pub(super) address: SocketAddr,
    _running: Running,
}

enum Running {
    Here(JoinHandle<()>),
    /// It ends with its standard input.
    There {
        _child: Child,
    },
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Self::Here(task) = self {
            task.abort();
        }
    }
}

impl Echo {
    /// Starts one that answers `answer`; in a process of its own if `apart`.
    ///
    /// # Errors
    /// The system refuses a port or a process.
    pub(super) async fn start(answer: &v1::ActResponse, apart: bool) -> anyhow::Result<Self> {
        if apart {
            return Self::start_process(answer).await.context("starting the echo's process");
        }
        let listener = listen().await?;
        let address = listener.local_addr()?;
        let service = service(answer.clone());
        let task = tokio::spawn(async move {
            // It ends by being aborted; until then, who calls it sees what goes wrong.
            let _ = transport().add_service(service).serve_with_incoming(incoming(listener)).await;
        });
        Ok(Self { address, _running: Running::Here(task) })
    }

    async fn start_process(answer: &v1::ActResponse) -> anyhow::Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .args(["bench", "echo"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()?;
        let to = child.stdin.as_mut().context("it has no standard input")?;
        let answer = answer.encode_to_vec();
        to.write_u64(answer.len() as u64).await?;
        to.write_all(&answer).await?;
        to.flush().await?;
        let from = child.stdout.take().context("it has no standard output")?;
        let mut line = String::new();
        BufReader::new(from).read_line(&mut line).await?;
        let address = line.trim().parse().with_context(|| format!("it says {line:?} instead of its address"))?;
        Ok(Self { address, _running: Running::There { _child: child } })
    }
}

/// `qedgix bench echo`: reads the answer from standard input, prints where it listens, serves until the input ends.
///
/// # Errors
/// The input is no answer, or the system refuses a port.
pub(in super::super) async fn serve() -> anyhow::Result<()> {
    let mut input = BufReader::new(tokio::io::stdin());
    let size = input.read_u64().await?;
    let mut answer = Vec::new();
    (&mut input).take(size.min(LARGEST as u64)).read_to_end(&mut answer).await?;
    let answer = v1::ActResponse::decode(&answer[..])?;
    let listener = listen().await?;
    println!("{}", listener.local_addr()?);
    let until = async move {
        // An input that breaks ends like one that is closed.
        let _ = tokio::io::copy(&mut input, &mut tokio::io::sink()).await;
    };
    tokio::select! {
        served = transport().add_service(service(answer)).serve_with_incoming(incoming(listener)) => Ok(served?),
        () = until => Ok(()),
    }
}

/// A bare transport with the server's settings.
fn transport() -> Transport {
    Transport::builder()
        .http2_keepalive_interval(Some(KEEPALIVE))
        .max_concurrent_streams(1024)
        .initial_stream_window_size(WINDOW)
        .initial_connection_window_size(WINDOW)
}

/// Connections on which nothing waits for a packet to fill.
fn incoming(listener: TcpListener) -> TcpIncoming {
    TcpIncoming::from(listener).with_nodelay(Some(true))
}

async fn listen() -> std::io::Result<TcpListener> {
    TcpListener::bind(("127.0.0.1", 0)).await
}

fn service(answer: v1::ActResponse) -> PolicyServiceServer<Canned> {
    PolicyServiceServer::new(Canned(Arc::new(answer))).max_decoding_message_size(LARGEST)
}

/// Has one answer to everything.
struct Canned(Arc<v1::ActResponse>);

fn absent<T>() -> Result<Response<T>, Status> {
    Err(Status::unimplemented("the echo answers Act and ActStream"))
}

#[tonic::async_trait]
impl PolicyService for Canned {
    async fn act(&self, _: Request<v1::ActRequest>) -> Result<Response<v1::ActResponse>, Status> {
        Ok(Response::new((*self.0).clone()))
    }

    type ActStreamStream = BoxStream<'static, Result<v1::ActResult, Status>>;

    async fn act_stream(&self, request: Request<Streaming<v1::ActRequest>>) -> Result<Response<Self::ActStreamStream>, Status> {
        let answer = self.0.clone();
        let result = move |_| v1::ActResult { result: Some(v1::act_result::Result::Response((*answer).clone())) };
        Ok(Response::new(request.into_inner().map(move |request| request.map(&result)).boxed()))
    }

    async fn act_batch(&self, _: Request<v1::ActBatchRequest>) -> Result<Response<v1::ActBatchResponse>, Status> {
        absent()
    }

    async fn open_session(&self, _: Request<v1::OpenSessionRequest>) -> Result<Response<v1::Session>, Status> {
        absent()
    }

    async fn get_session(&self, _: Request<v1::GetSessionRequest>) -> Result<Response<v1::Session>, Status> {
        absent()
    }

    async fn list_sessions(&self, _: Request<v1::ListSessionsRequest>) -> Result<Response<v1::ListSessionsResponse>, Status> {
        absent()
    }

    async fn close_session(&self, _: Request<v1::CloseSessionRequest>) -> Result<Response<v1::Session>, Status> {
        absent()
    }

    async fn list_policies(&self, _: Request<v1::ListPoliciesRequest>) -> Result<Response<v1::ListPoliciesResponse>, Status> {
        absent()
    }

    async fn get_policy(&self, _: Request<v1::GetPolicyRequest>) -> Result<Response<v1::Policy>, Status> {
        absent()
    }
}
