//! The echo service that `Act` is compared with: it decodes the requests of `Act` and always returns the same `ActResponse`.
//!
//! It uses the transport settings of the server. It runs in this process when the server does, and in a process of its own
//! otherwise.

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

use crate::cli::output::outln;
use crate::server::{CONNECTION_WINDOW, KEEPALIVE_INTERVAL, STREAM_WINDOW};
use crate::wire::v1;
use crate::wire::v1::policy_service_server::{PolicyService, PolicyServiceServer};

/// Maximum request size in bytes: the maximum of `--max-message-size`.
const MAX_MESSAGE_SIZE: usize = 1 << 30;

/// A running echo service; dropping it stops the service.
pub(super) struct Echo {
    /// Address of the service.
    pub(super) address: SocketAddr,
    _running: Running,
}

enum Running {
    Task(JoinHandle<()>),
    /// The process ends when its standard input closes.
    Process {
        _child: Child,
    },
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Self::Task(task) = self {
            task.abort();
        }
    }
}

impl Echo {
    /// Starts a service that returns `response`, in a process of its own if `own_process`.
    ///
    /// # Errors
    /// No port can be bound, or the process cannot be started.
    pub(super) async fn start(response: &v1::ActResponse, own_process: bool) -> anyhow::Result<Self> {
        if own_process {
            return Self::start_process(response).await.context("cannot start the echo process");
        }
        let listener = listen().await?;
        let address = listener.local_addr()?;
        let service = service(response.clone());
        let task = tokio::spawn(async move {
            // Callers see failures of the service, so its result is not needed. The task ends by abort.
            let _ = transport().add_service(service).serve_with_incoming(incoming(listener)).await;
        });
        Ok(Self { address, _running: Running::Task(task) })
    }

    async fn start_process(response: &v1::ActResponse) -> anyhow::Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .args(["bench", "echo"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()?;
        let to = child.stdin.as_mut().context("no standard input")?;
        let response = response.encode_to_vec();
        to.write_u64(response.len() as u64).await?;
        to.write_all(&response).await?;
        to.flush().await?;
        let from = child.stdout.take().context("no standard output")?;
        let mut line = String::new();
        BufReader::new(from).read_line(&mut line).await?;
        let address = line.trim().parse().with_context(|| format!("expected an address, received {line:?}"))?;
        Ok(Self { address, _running: Running::Process { _child: child } })
    }
}

/// `qedgix bench echo`: reads the response from standard input, prints the address, and serves until standard input closes.
///
/// # Errors
/// The input is not an `ActResponse`, or no port can be bound.
pub(in super::super) async fn serve() -> anyhow::Result<()> {
    let mut input = BufReader::new(tokio::io::stdin());
    let size = input.read_u64().await?;
    let mut response = Vec::new();
    (&mut input).take(size.min(MAX_MESSAGE_SIZE as u64)).read_to_end(&mut response).await?;
    let response = v1::ActResponse::decode(&response[..])?;
    let listener = listen().await?;
    outln!("{}", listener.local_addr()?)?;
    let input_closed = async move {
        // A broken input counts as closed.
        let _ = tokio::io::copy(&mut input, &mut tokio::io::sink()).await;
    };
    tokio::select! {
        served = transport().add_service(service(response)).serve_with_incoming(incoming(listener)) => Ok(served?),
        () = input_closed => Ok(()),
    }
}

/// A gRPC server with the transport settings of the Qedgix server.
fn transport() -> Transport {
    Transport::builder()
        .http2_keepalive_interval(Some(KEEPALIVE_INTERVAL))
        .max_concurrent_streams(1024)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
}

/// Connections with TCP_NODELAY, as the server has them.
fn incoming(listener: TcpListener) -> TcpIncoming {
    TcpIncoming::from(listener).with_nodelay(Some(true))
}

async fn listen() -> std::io::Result<TcpListener> {
    TcpListener::bind(("127.0.0.1", 0)).await
}

fn service(response: v1::ActResponse) -> PolicyServiceServer<FixedResponse> {
    PolicyServiceServer::new(FixedResponse(Arc::new(response))).max_decoding_message_size(MAX_MESSAGE_SIZE)
}

/// Returns the same response to every `Act`.
struct FixedResponse(Arc<v1::ActResponse>);

fn unimplemented<T>() -> Result<Response<T>, Status> {
    Err(Status::unimplemented("the echo service implements Act and ActStream only"))
}

#[tonic::async_trait]
impl PolicyService for FixedResponse {
    async fn act(&self, _: Request<v1::ActRequest>) -> Result<Response<v1::ActResponse>, Status> {
        Ok(Response::new((*self.0).clone()))
    }

    type ActStreamStream = BoxStream<'static, Result<v1::ActResult, Status>>;

    async fn act_stream(&self, request: Request<Streaming<v1::ActRequest>>) -> Result<Response<Self::ActStreamStream>, Status> {
        let response = self.0.clone();
        let result = move |_| v1::ActResult { result: Some(v1::act_result::Result::Response((*response).clone())) };
        Ok(Response::new(request.into_inner().map(move |request| request.map(&result)).boxed()))
    }

    async fn act_batch(&self, _: Request<v1::ActBatchRequest>) -> Result<Response<v1::ActBatchResponse>, Status> {
        unimplemented()
    }

    async fn encode(&self, _: Request<v1::EncodeRequest>) -> Result<Response<v1::EncodeResponse>, Status> {
        unimplemented()
    }

    async fn decide(&self, _: Request<v1::DecideRequest>) -> Result<Response<v1::DecideResponse>, Status> {
        unimplemented()
    }

    async fn open_session(&self, _: Request<v1::OpenSessionRequest>) -> Result<Response<v1::Session>, Status> {
        unimplemented()
    }

    async fn get_session(&self, _: Request<v1::GetSessionRequest>) -> Result<Response<v1::Session>, Status> {
        unimplemented()
    }

    async fn list_sessions(&self, _: Request<v1::ListSessionsRequest>) -> Result<Response<v1::ListSessionsResponse>, Status> {
        unimplemented()
    }

    async fn close_session(&self, _: Request<v1::CloseSessionRequest>) -> Result<Response<v1::Session>, Status> {
        unimplemented()
    }

    async fn list_policies(&self, _: Request<v1::ListPoliciesRequest>) -> Result<Response<v1::ListPoliciesResponse>, Status> {
        unimplemented()
    }

    async fn get_policy(&self, _: Request<v1::GetPolicyRequest>) -> Result<Response<v1::Policy>, Status> {
        unimplemented()
    }
    async fn list_policy_versions(
        &self,
        _: Request<v1::ListPolicyVersionsRequest>,
    ) -> Result<Response<v1::ListPolicyVersionsResponse>, Status> {
        unimplemented()
    }

    async fn delete_policy_version(
        &self,
        _: Request<v1::DeletePolicyVersionRequest>,
    ) -> Result<Response<v1::DeletePolicyVersionResponse>, Status> {
        unimplemented()
    }

    async fn delete_policy(&self, _: Request<v1::DeletePolicyRequest>) -> Result<Response<v1::DeletePolicyResponse>, Status> {
        unimplemented()
    }
}
