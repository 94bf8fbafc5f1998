//! Connections of a listener: accepted, bounded in number, put through TLS, spoken HTTP on, and let go when the server stops.
//!
//! Nothing that a caller does or leaves undone holds up others: handshakes are made in the connection's own task, and every
//! stage before a request has its time.

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

use super::prompt::Prompt;
use super::tls::{H2, Tls};

/// What a connection may send before the server has read it, in bytes: a large fleet's observation.
pub const WINDOW: u32 = 4 << 20;
/// Pause between two questions whether a silent HTTP/2 caller is still there.
pub const KEEPALIVE: Duration = Duration::from_secs(30);
/// Time that it has to answer.
const KEEPALIVE_ANSWER: Duration = Duration::from_secs(20);
/// Pause after the system had no connection to give, although there was one: too many files are open.
const EXHAUSTED: Duration = Duration::from_millis(500);

/// What is spoken on a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Protocol {
    /// HTTP/2.
    Grpc,
    /// HTTP/1.1; within TLS also HTTP/2, if the caller prefers it.
    Http,
}

/// What the connections of listeners share; cheap to clone.
#[derive(Clone)]
pub(super) struct Connections {
    /// One for each connection that there may be.
    pub(super) permits: Arc<Semaphore>,
    pub(super) tls: Option<Arc<Tls>>,
    /// Time for a handshake, for the head of an HTTP/1 request, for the next part of a REST body.
    pub(super) patience: Duration,
    /// HTTP/2 streams per connection.
    pub(super) max_streams: u32,
    pub(super) stop: CancellationToken,
}

impl Connections {
    /// Serves until `stop`; returns when requests in flight are answered. Dropped, it ends all connections at once.
    pub(super) async fn serve<S, B>(self, listener: TcpListener, protocol: Protocol, service: S)
    where
        S: Service<Request<Incoming>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let (graceful, mut tasks) = (GracefulShutdown::new(), JoinSet::new());
        let open = metrics::gauge!("qedgix_connections");
        let turned_away = metrics::counter!("qedgix_connections_refused_total");
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
                        let one = Open { _permit: permit, gauge: open.clone() };
                        one.gauge.increment(1.0);
                        tasks.spawn(self.clone().connection(stream, protocol, service.clone(), graceful.watcher(), one));
                    }
                    // Closed at once: a caller that is told goes elsewhere or comes again; one that waits thinks the server hangs.
                    Err(_) => turned_away.increment(1),
                },
                Err(e) if of_the_caller(&e) => {}
                Err(error) => {
                    tracing::error!(%error, "accepting a connection");
                    tokio::time::sleep(EXHAUSTED).await;
                }
            }
        }
        // The port is free while the last answers are given.
        drop(listener);
        graceful.shutdown().await;
    }

    async fn connection<S, B>(self, stream: TcpStream, protocol: Protocol, service: S, watcher: Watcher, _open: Open)
    where
        S: Service<Request<Incoming>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        // Only latency is lost where it cannot be set.
        let _ = stream.set_nodelay(true);
        let Some(tls) = &self.tls else { return self.speak(stream, protocol == Protocol::Grpc, service, watcher).await };
        let configs = tls.now();
        let config = if protocol == Protocol::Grpc { configs.grpc } else { configs.http };
        let handshake = tokio::time::timeout(self.patience, TlsAcceptor::from(config).accept(stream));
        let shaken = tokio::select! {
            shaken = handshake => shaken,
            () = self.stop.cancelled() => return,
        };
        match shaken {
            Ok(Ok(stream)) => {
                let agreed = stream.get_ref().1.alpn_protocol();
                // Who speaks of no protocol means the one of the port.
                let http2 = agreed.map_or(protocol == Protocol::Grpc, |agreed| agreed == H2);
                self.speak(stream, http2, service, watcher).await;
            }
            Ok(Err(error)) => tracing::debug!(%error, "no TLS handshake"),
            Err(_) => tracing::debug!(after = ?self.patience, "no TLS handshake in time"),
        }
    }

    async fn speak<IO, S, B>(&self, io: IO, http2: bool, service: S, watcher: Watcher)
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
                .initial_stream_window_size(WINDOW)
                .initial_connection_window_size(WINDOW)
                .max_concurrent_streams(self.max_streams)
                .keep_alive_interval(KEEPALIVE)
                .keep_alive_timeout(KEEPALIVE_ANSWER);
            // From its first frame on a caller has to answer pings; this is for what comes before.
            let io = TokioIo::new(Prompt::new(io, PREFACE, self.patience));
            watcher.watch(builder.serve_connection(io, service)).await
        } else {
            let mut builder = http1::Builder::new();
            builder.timer(TokioTimer::new()).header_read_timeout(self.patience);
            watcher.watch(builder.serve_connection(TokioIo::new(io), service)).await
        };
        if let Err(error) = served {
            tracing::debug!(%error, "a connection broke");
        }
    }
}

/// Bytes with which an HTTP/2 caller introduces itself.
const PREFACE: usize = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".len();

/// One of the connections that there may be.
struct Open {
    _permit: OwnedSemaphorePermit,
    gauge: metrics::Gauge,
}

impl Drop for Open {
    fn drop(&mut self) {
        self.gauge.decrement(1.0);
    }
}

/// Whether a caller went away before it was let in: nothing is wrong here.
fn of_the_caller(error: &io::Error) -> bool {
    use io::ErrorKind as E;
    matches!(error.kind(), E::ConnectionRefused | E::ConnectionAborted | E::ConnectionReset)
}
