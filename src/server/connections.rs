//! Connections of a listener: accepting, the limit on their number, TLS handshakes, HTTP, graceful shutdown.
//!
//! A slow caller never delays another one: each connection has its own task, which includes the TLS handshake, and each stage
//! before a request has a timeout.

use std::convert::Infallible;
use std::error::Error;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use hyper::body::{Body, Incoming};
use hyper::server::conn::{http1, http2};
use hyper::{Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tower::Service;

use super::read_timeout::FirstBytesTimeout;
use super::tls::{H2, Tls};

/// HTTP/2 flow-control window in bytes: holds the observation of a large fleet.
pub const HTTP2_WINDOW: u32 = 4 << 20;
/// Time between two pings of a silent HTTP/2 connection.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(30);
/// Time in which a ping must be answered.
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(20);
/// Pause after `accept` failed for lack of resources, such as too many open files.
const ACCEPT_RETRY: Duration = Duration::from_millis(500);

/// The protocol of a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Protocol {
    /// HTTP/2.
    Grpc,
    /// HTTP/1.1; with TLS also HTTP/2 when the caller negotiates it (ALPN).
    Http,
}

/// Settings and limits that connections share; cheap to clone.
#[derive(Clone)]
pub(super) struct Connections {
    /// One permit per allowed connection.
    pub(super) permits: Arc<Semaphore>,
    pub(super) tls: Option<Arc<Tls>>,
    /// Timeout of a TLS handshake, of the HTTP/2 preface and of the head of an HTTP/1 request.
    pub(super) read_timeout: Duration,
    /// Maximum HTTP/2 streams per connection.
    pub(super) max_streams: u32,
    /// Cancelled when the server stops accepting.
    pub(super) stop: CancellationToken,
}

impl Connections {
    /// Serves until `stop` is cancelled and returns when all requests in flight are answered. Dropping the future closes all
    /// connections at once.
    pub(super) async fn serve<S, B>(self, listener: TcpListener, protocol: Protocol, service: S)
    where
        S: Service<Request<Incoming>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let (graceful, mut tasks) = (GracefulShutdown::new(), JoinSet::new());
        let open = metrics::gauge!("qedgix_connections");
        let refused = metrics::counter!("qedgix_connections_refused_total");
        loop {
            let accepted = tokio::select! {
                biased;
                () = self.stop.cancelled() => break,
                Some(_) = tasks.join_next() => continue,
                accepted = listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, _)) => match Arc::clone(&self.permits).try_acquire_owned() {
                    Ok(permit) => {
                        let connection = OpenConnection { _permit: permit, gauge: open.clone() };
                        connection.gauge.increment(1.0);
                        tasks.spawn(self.clone().connection(stream, protocol, service.clone(), graceful.watcher(), connection));
                    }
                    // Closing at once lets the caller retry or use another server; waiting would look like a hang.
                    Err(_) => refused.increment(1),
                },
                Err(e) if is_caller_error(&e) => {}
                Err(error) => {
                    tracing::error!(%error, "cannot accept a connection");
                    tokio::time::sleep(ACCEPT_RETRY).await;
                }
            }
        }
        // Frees the port while the last requests are answered.
        drop(listener);
        graceful.shutdown().await;
    }

    async fn connection<S, B>(self, stream: TcpStream, protocol: Protocol, service: S, watcher: Watcher, _open: OpenConnection)
    where
        S: Service<Request<Incoming>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        // Failure costs latency only.
        let _ = stream.set_nodelay(true);
        let Some(tls) = &self.tls else { return self.serve_http(stream, protocol == Protocol::Grpc, service, watcher).await };
        let configs = tls.current();
        let config = if protocol == Protocol::Grpc { configs.grpc } else { configs.http };
        let handshake = tokio::time::timeout(self.read_timeout, TlsAcceptor::from(config).accept(stream));
        let handshake = tokio::select! {
            done = handshake => done,
            () = self.stop.cancelled() => return,
        };
        match handshake {
            Ok(Ok(stream)) => {
                let agreed = stream.get_ref().1.alpn_protocol();
                // Without ALPN, the connection uses the default protocol of the port.
                let http2 = agreed.map_or(protocol == Protocol::Grpc, |agreed| agreed == H2);
                self.serve_http(stream, http2, service, watcher).await;
            }
            Ok(Err(error)) => tracing::debug!(%error, "TLS handshake failed"),
            Err(_) => tracing::debug!(timeout = ?self.read_timeout, "TLS handshake timed out"),
        }
    }

    async fn serve_http<IO, S, B>(&self, io: IO, http2: bool, service: S, watcher: Watcher)
    where
        IO: AsyncRead + AsyncWrite + Send + Unpin + 'static,
        S: Service<Request<Incoming>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let service = TowerToHyperService::new(service);
        let served = if http2 {
            let mut builder = http2::Builder::new(TokioExecutor::new());
            builder
                .timer(TokioTimer::new())
                .initial_stream_window_size(HTTP2_WINDOW)
                .initial_connection_window_size(HTTP2_WINDOW)
                .max_concurrent_streams(self.max_streams)
                .keep_alive_interval(KEEPALIVE_INTERVAL)
                .keep_alive_timeout(KEEPALIVE_TIMEOUT);
            // Pings detect silent callers once HTTP/2 has begun; the preface needs a timeout of its own.
            let io = TokioIo::new(FirstBytesTimeout::new(io, PREFACE_LEN, self.read_timeout));
            watcher.watch(builder.serve_connection(io, service)).await
        } else {
            let mut builder = http1::Builder::new();
            builder.timer(TokioTimer::new()).header_read_timeout(self.read_timeout);
            watcher.watch(builder.serve_connection(TokioIo::new(io), service)).await
        };
        if let Err(error) = served {
            tracing::debug!(%error, "connection failed");
        }
    }
}

/// Length of the HTTP/2 connection preface in bytes.
const PREFACE_LEN: usize = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".len();

/// An open connection: holds its permit and counts it in the gauge.
struct OpenConnection {
    _permit: OwnedSemaphorePermit,
    gauge: metrics::Gauge,
}

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.gauge.decrement(1.0);
    }
}

/// Whether `accept` failed because the caller closed the connection early, which is no fault of the server.
fn is_caller_error(error: &io::Error) -> bool {
    use io::ErrorKind as E;
    matches!(error.kind(), E::ConnectionRefused | E::ConnectionAborted | E::ConnectionReset)
}
