//! Connections of a listener: accepting, their permits, TLS handshakes, HTTP, graceful shutdown.
//!
//! A slow caller never delays another one: each connection has its own task, which includes the TLS handshake, and each stage
//! has a time limit.

use std::convert::Infallible;
use std::error::Error;
use std::io;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::http::{Request, Response};
use bytes::Bytes;
use hyper::body::{Body, Incoming};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tower::{Service, ServiceExt};

use super::http2;
use super::lifetime::{LifeLimits, Lifetime, Verdict};
use super::permits::{Permit, Permits};
use super::tls::{H2, Tls};
use super::write_timeout::WriteTimeout;
use crate::api::body::{Exchange, IncomingBody, TimeLimits};
use crate::clock::Clock;

/// Pause after `accept` failed for lack of resources, such as too many open files.
const ACCEPT_RETRY: Duration = Duration::from_millis(500);
/// Memory for the head of an HTTP/1 request in bytes, beyond which hyper reads no further. What it has read until then may be more.
const HTTP1_BUFFER: usize = 64 << 10;
/// Limits of the life of a connection from the reserve, which has one request.
const RESERVED_LIFE: Duration = Duration::from_secs(2);

/// The protocol of a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Protocol {
    /// HTTP/2.
    Grpc,
    /// HTTP/1.1; with TLS also HTTP/2 when the caller negotiates it (ALPN).
    Http,
}

/// The version of HTTP on a connection.
#[derive(Clone, Copy, Debug)]
enum Version {
    Http1,
    /// `date`: responses have a date, as HTTP requires and gRPC does not use.
    Http2 {
        date: bool,
    },
}

/// Settings and limits that connections share; cheap to clone.
#[derive(Clone)]
pub(super) struct Connections {
    pub(super) permits: Arc<Permits>,
    pub(super) tls: Option<Arc<Tls>>,
    /// Time limits of requests and responses. The one for reading also applies to a TLS handshake, the HTTP/2 preface and the
    /// head of an HTTP/1 request.
    pub(super) limits: TimeLimits,
    pub(super) life: LifeLimits,
    /// Maximum HTTP/2 streams per connection.
    pub(super) max_streams: u32,
    pub(super) clock: Clock,
    /// Cancelled when the server stops accepting.
    pub(super) stop: CancellationToken,
    /// Answers the calls that may wait.
    pub(super) background: Handle,
}

impl Connections {
    /// Serves until `stop` is cancelled and returns when all requests in flight are answered. Dropping the future closes all
    /// connections at once.
    pub(super) async fn serve<S, B>(self, listener: TcpListener, protocol: Protocol, service: S)
    where
        S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let mut tasks = JoinSet::new();
        let refused = metrics::counter!("qedgix_connections_refused_total");
        loop {
            let accepted = tokio::select! {
                biased;
                () = self.stop.cancelled() => break,
                Some(_) = tasks.join_next() => continue,
                accepted = listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => match self.permits.take(peer.ip()) {
                    Some(permit) => {
                        tasks.spawn(self.clone().connection(stream, protocol, service.clone(), permit));
                    }
                    // Closing at once lets the caller retry or use another server; waiting would look like a hang.
                    None => refused.increment(1),
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
        while tasks.join_next().await.is_some() {}
    }

    async fn connection<S, B>(mut self, stream: TcpStream, protocol: Protocol, service: S, permit: Permit)
    where
        S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        if permit.reserved {
            self.shorten();
        }
        // Failure costs latency only.
        let _ = stream.set_nodelay(true);
        let stream = WriteTimeout::new(stream, self.limits.write);
        let Some(tls) = &self.tls else {
            let version = if protocol == Protocol::Grpc { Version::Http2 { date: false } } else { Version::Http1 };
            return self.serve_http(stream, version, service, &permit).await;
        };
        let configs = tls.current();
        let config = if protocol == Protocol::Grpc { configs.grpc } else { configs.http };
        let handshake = tokio::time::timeout(self.limits.read, TlsAcceptor::from(config).accept(stream));
        let handshake = tokio::select! {
            done = handshake => done,
            () = self.stop.cancelled() => return,
        };
        match handshake {
            Ok(Ok(stream)) => {
                let agreed = stream.get_ref().1.alpn_protocol();
                // Without ALPN, the connection uses the default protocol of the port.
                let http2 = agreed.map_or(protocol == Protocol::Grpc, |agreed| agreed == H2);
                let version = if http2 { Version::Http2 { date: protocol == Protocol::Http } } else { Version::Http1 };
                self.serve_http(stream, version, service, &permit).await;
            }
            Ok(Err(error)) => tracing::debug!(%error, "TLS handshake failed"),
            Err(_) => tracing::debug!(timeout = ?self.limits.read, "TLS handshake timed out"),
        }
    }

    /// Limits the life of a connection from the reserve.
    fn shorten(&mut self) {
        let tick = self.life.tick.min(RESERVED_LIFE / 4);
        self.life = LifeLimits { idle: RESERVED_LIFE, age: RESERVED_LIFE, grace: RESERVED_LIFE, tick };
        self.limits.read = self.limits.read.min(RESERVED_LIFE);
        self.limits.write = self.limits.write.min(RESERVED_LIFE);
    }

    async fn serve_http<IO, S, B>(&self, io: IO, version: Version, service: S, permit: &Permit)
    where
        IO: AsyncRead + AsyncWrite + Send + Unpin + 'static,
        S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let mut jitter = [128];
        // Without a random source, all connections have the same age.
        let _ = getrandom::fill(&mut jitter);
        let jitter = f64::from(jitter[0]) / 255.0;
        let lifetime = Lifetime::new(self.life, self.clock.clone(), self.stop.clone(), permit.reserved, jitter);
        if let Version::Http2 { date } = version {
            let (max_streams, limits, purse) = (self.max_streams, self.limits, permit.purse.clone());
            let settings = http2::Settings { max_streams, limits, purse, date, background: self.background.clone() };
            if let Err(error) = http2::serve(io, service, &settings, lifetime).await {
                tracing::debug!(%error, "connection failed");
            }
        } else {
            self.serve_http1(io, service, lifetime, permit).await;
        }
    }

    async fn serve_http1<IO, S, B>(&self, io: IO, service: S, mut lifetime: Lifetime, permit: &Permit)
    where
        IO: AsyncRead + AsyncWrite + Send + Unpin + 'static,
        S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
        S::Future: Send,
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn Error + Send + Sync>>,
    {
        let (reserved, read, purse) = (permit.reserved, self.limits.read, permit.purse.clone());
        let service = service_fn(move |request: Request<Incoming>| {
            let exchange = Exchange::http1(purse.clone(), reserved);
            service.clone().oneshot(request.map(|body| IncomingBody::http1(body, exchange, read)))
        });
        let mut builder = http1::Builder::new();
        // The timeout for the head of a request includes the time between two requests.
        builder.timer(TokioTimer::new()).header_read_timeout(read).max_buf_size(HTTP1_BUFFER).keep_alive(!reserved);
        let mut connection = pin!(builder.serve_connection(TokioIo::new(io), service));
        let mut ticks = tokio::time::interval(lifetime.tick());
        let mut stopped = pin!(self.stop.cancelled());
        loop {
            tokio::select! {
                biased;
                served = connection.as_mut() => {
                    if let Err(error) = served {
                        tracing::debug!(%error, "connection failed");
                    }
                    return;
                }
                () = stopped.as_mut(), if !lifetime.is_closing() => {
                    lifetime.begin_close("shutdown");
                    connection.as_mut().graceful_shutdown();
                }
                // hyper closes idle connections.
                _ = ticks.tick() => match lifetime.check(true) {
                    Verdict::Stay => {}
                    Verdict::Leave => connection.as_mut().graceful_shutdown(),
                    Verdict::Close => return,
                },
            }
        }
    }
}

/// Whether `accept` failed because the caller closed the connection early, which is no fault of the server.
fn is_caller_error(error: &io::Error) -> bool {
    use io::ErrorKind as E;
    matches!(error.kind(), E::ConnectionRefused | E::ConnectionAborted | E::ConnectionReset)
}
