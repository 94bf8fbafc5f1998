//! HTTP/2 connections: requests to the service, responses to the caller, and the limits on both.
//!
//! This speaks to `h2` directly, as hyper does, because hyper neither lets flow control depend on the use of the bytes nor knows
//! idle connections, their age, or callers that do not take their responses.

use std::convert::Infallible;
use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::{Arc, Weak};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::http::{HeaderMap, Request, Response, header};
use bytes::Bytes;
use h2::server::{Connection, SendResponse};
use h2::{Ping, PingPong, Reason, RecvStream, SendStream};
use hyper::body::Body;
use pin_project_lite::pin_project;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::Handle;
use tokio::time::{Interval, MissedTickBehavior};
use tower::util::Oneshot;
use tower::{Service, ServiceExt};

use super::lifetime::{Lifetime, Verdict};
use crate::api::access::grpc_may_wait;
use crate::api::body::{Exchange, IncomingBody, TimeLimits};
use crate::inflight::Purse;

/// Flow-control window of a stream in bytes: holds the observation of a large fleet. Also the most that is kept of a stream whose
/// requests are not answered as fast as they arrive.
pub const STREAM_WINDOW: u32 = 1 << 20;
/// Flow-control window of a connection in bytes: several streams that wait do not stop the others.
pub const CONNECTION_WINDOW: u32 = 16 << 20;
/// Time between two pings.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(30);
/// Time in which a ping must be answered.
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum size of the headers of a request in bytes. `h2` closes connections that send more CONTINUATION frames than this takes.
const MAX_HEADERS: u32 = 16 << 10;
/// Responses wait in their stream and not in the buffers of `h2`, which hold at most so many bytes per stream.
const MAX_SEND_BUFFER: usize = 32 << 10;
/// Streams that the caller opens and resets faster than they are accepted: beyond, the connection is closed (rapid reset).
const MAX_PENDING_RESETS: usize = 20;
/// Streams that the server resets because of errors of the caller: beyond, the connection is closed.
const MAX_ERROR_RESETS: usize = 256;
/// Overhead of small DATA frames that `h2` holds, which it counts as up to 256 bytes each: beyond, the connection is closed. Tasks
/// take their frames out as they arrive, so this must only hold what one stream sends while its task waits for a thread: a whole
/// window of messages without content, of 5 bytes each.
const FRAME_BUDGET: usize = 256 / 5 * STREAM_WINDOW as usize;
/// Time to send the last frame of a connection.
const GOODBYE: Duration = Duration::from_secs(1);

/// Settings of a connection.
pub(super) struct Settings {
    pub(super) max_streams: u32,
    pub(super) limits: TimeLimits,
    pub(super) purse: Arc<Purse>,
    /// Whether responses have a date, as HTTP requires and gRPC does not use.
    pub(super) date: bool,
    /// Answers the calls that may wait.
    pub(super) background: Handle,
}

/// Serves a connection until it ends.
pub(super) async fn serve<IO, S, B>(io: IO, service: S, settings: &Settings, lifetime: Lifetime) -> Result<(), h2::Error>
where
    IO: AsyncRead + AsyncWrite + Unpin,
    S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
    S::Future: Send,
    B: Body<Data = Bytes> + Send + 'static,
{
    let mut builder = h2::server::Builder::new();
    builder
        .initial_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_concurrent_streams(settings.max_streams)
        .max_header_list_size(MAX_HEADERS)
        .max_send_buffer_size(MAX_SEND_BUFFER)
        .max_pending_accept_reset_streams(MAX_PENDING_RESETS)
        .max_local_error_reset_streams(Some(MAX_ERROR_RESETS))
        .data_frame_budget(FRAME_BUDGET);
    let Ok(connection) = tokio::time::timeout(settings.limits.read, builder.handshake(io)).await else {
        tracing::debug!(timeout = ?settings.limits.read, "HTTP/2 preface timed out");
        return Ok(());
    };
    let mut connection = connection?;
    let pings = connection.ping_pong().map(|pings| KeepAlive { pings, asked: None, silent_since: Instant::now() });
    let mut ticks = tokio::time::interval(lifetime.tick());
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    Serving { connection, service, settings, lifetime, pings, ticks, exchanges: Exchanges::default() }.run().await
}

struct Serving<'a, IO, S> {
    connection: Connection<IO, Bytes>,
    service: S,
    settings: &'a Settings,
    lifetime: Lifetime,
    pings: Option<KeepAlive>,
    ticks: Interval,
    exchanges: Exchanges,
}

type Accepted = Option<Result<(Request<RecvStream>, SendResponse<Bytes>), h2::Error>>;

#[allow(clippy::large_enum_variant, reason = "one value at a time, on the stack")]
enum Event {
    Accepted(Accepted),
    Stop,
    Tick,
}

impl<IO, S, B> Serving<'_, IO, S>
where
    IO: AsyncRead + AsyncWrite + Unpin,
    S: Service<Request<IncomingBody>, Response = Response<B>, Error = Infallible> + Clone + Send + 'static,
    S::Future: Send,
    B: Body<Data = Bytes> + Send + 'static,
{
    async fn run(mut self) -> Result<(), h2::Error> {
        let stop = self.lifetime.stop().clone();
        let mut stopped = pin!(stop.cancelled());
        loop {
            let event = poll_fn(|context| {
                // First, so that a flood of requests does not put off the checks.
                if self.ticks.poll_tick(context).is_ready() {
                    return Poll::Ready(Event::Tick);
                }
                if let Poll::Ready(accepted) = self.connection.poll_accept(context) {
                    return Poll::Ready(Event::Accepted(accepted));
                }
                if let Some(pings) = &mut self.pings {
                    pings.poll(context);
                }
                if !self.lifetime.is_closing() && stopped.as_mut().poll(context).is_ready() {
                    return Poll::Ready(Event::Stop);
                }
                Poll::Pending
            });
            match event.await {
                Event::Accepted(Some(accepted)) => {
                    let (request, reply) = accepted?;
                    self.spawn(request, reply);
                }
                Event::Accepted(None) => return Ok(()),
                Event::Stop => {
                    self.lifetime.begin_close("shutdown");
                    self.connection.graceful_shutdown();
                }
                Event::Tick => {
                    let busy = self.exchanges.check(&self.lifetime, &self.settings.limits);
                    let lost = self.pings.as_mut().is_some_and(KeepAlive::is_lost);
                    match self.lifetime.check(busy) {
                        _ if lost => return self.close(Reason::NO_ERROR).await,
                        Verdict::Stay => {}
                        Verdict::Leave => self.connection.graceful_shutdown(),
                        Verdict::Close => return self.close(Reason::NO_ERROR).await,
                    }
                }
            }
        }
    }

    fn spawn(&mut self, request: Request<RecvStream>, reply: SendResponse<Bytes>) {
        self.lifetime.requested();
        let reserved = self.lifetime.is_single();
        if reserved && !self.lifetime.is_closing() {
            self.lifetime.begin_close("reserve");
            self.connection.graceful_shutdown();
        }
        let (head, stream) = request.into_parts();
        let may_wait = grpc_may_wait(head.uri.path());
        let exchange = Exchange::http2(self.settings.purse.clone(), reserved, stream);
        self.exchanges.add(&exchange);
        let request = Request::from_parts(head, IncomingBody::http2(exchange.clone()));
        let work = self.service.clone().oneshot(request);
        let stage = Stage::<Oneshot<S, Request<IncomingBody>>, B>::Service { work };
        let task = StreamTask { reply, exchange, date: self.settings.date, stage };
        if may_wait {
            self.settings.background.spawn(task);
        } else {
            tokio::spawn(task);
        }
    }

    /// Says goodbye and closes the connection, with all its streams.
    async fn close(mut self, reason: Reason) -> Result<(), h2::Error> {
        self.connection.abrupt_shutdown(reason);
        let closed = poll_fn(|context| self.connection.poll_closed(context));
        tokio::time::timeout(GOODBYE, closed).await.unwrap_or(Ok(()))
    }
}

/// The exchanges of a connection, for the regular check of their time limits.
#[derive(Default)]
struct Exchanges {
    all: Vec<Weak<Exchange>>,
    /// Number from which on finished ones are removed.
    full: usize,
}

impl Exchanges {
    fn add(&mut self, exchange: &Arc<Exchange>) {
        if self.all.len() >= self.full {
            self.all.retain(|exchange| exchange.strong_count() > 0);
            self.full = 2 * self.all.len() + 64;
        }
        self.all.push(Arc::downgrade(exchange));
    }

    /// Checks the time limits of all open exchanges. Returns whether there are any.
    fn check(&mut self, lifetime: &Lifetime, limits: &TimeLimits) -> bool {
        let now = lifetime.now();
        self.all.retain(|exchange| exchange.upgrade().map(|exchange| exchange.check(now, limits)).is_some());
        !self.all.is_empty()
    }
}

/// Pings the caller and notices when it does not answer.
struct KeepAlive {
    pings: PingPong,
    /// When the last ping was sent, if it is not answered.
    asked: Option<Instant>,
    silent_since: Instant,
}

impl KeepAlive {
    fn poll(&mut self, context: &mut Context<'_>) {
        if self.asked.is_some() && self.pings.poll_pong(context).is_ready() {
            (self.asked, self.silent_since) = (None, Instant::now());
        }
    }

    /// Sends a ping when it is time. Returns whether the last one was not answered.
    fn is_lost(&mut self) -> bool {
        match self.asked {
            Some(asked) => return asked.elapsed() >= KEEPALIVE_TIMEOUT,
            None if self.silent_since.elapsed() >= KEEPALIVE_INTERVAL && self.pings.send_ping(Ping::opaque()).is_ok() => {
                self.asked = Some(Instant::now());
            }
            None => {}
        }
        false
    }
}

pin_project! {
    /// Runs one request and sends its response.
    struct StreamTask<F, B> {
        reply: SendResponse<Bytes>,
        exchange: Arc<Exchange>,
        date: bool,
        #[pin]
        stage: Stage<F, B>,
    }
}

pin_project! {
    #[project = StageProjection]
    enum Stage<F, B> {
        Service { #[pin] work: F },
        Body { #[pin] body: B, sender: Sender },
    }
}

impl<F, B> Future for StreamTask<F, B>
where
    F: Future<Output = Result<Response<B>, Infallible>>,
    B: Body<Data = Bytes>,
{
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<()> {
        loop {
            let mut this = self.as_mut().project();
            let polled = match this.stage.as_mut().project() {
                StageProjection::Service { work } => match work.poll(context) {
                    Poll::Ready(Ok(response)) => match begin_response(this.reply, response, *this.date) {
                        Some((sender, body)) => {
                            this.stage.set(Stage::Body { body, sender });
                            continue;
                        }
                        None => Poll::Ready(()),
                    },
                    // A caller that has reset the stream wants no response.
                    Poll::Pending => this.reply.poll_reset(context).map(drop),
                },
                StageProjection::Body { body, sender } => sender.poll(context, body, this.exchange),
            };
            if polled.is_ready() || !this.exchange.receive(context) {
                return polled;
            }
        }
    }
}

/// Sends the head of the response. Returns the rest, if there is any.
fn begin_response<B: Body<Data = Bytes>>(
    reply: &mut SendResponse<Bytes>,
    response: Response<B>,
    date: bool,
) -> Option<(Sender, B)> {
    let (mut head, body) = response.into_parts();
    remove_connection_headers(&mut head.headers);
    if date && !head.headers.contains_key(header::DATE) {
        let now = jiff::fmt::rfc2822::DateTimePrinter::new().timestamp_to_rfc9110_string(&jiff::Timestamp::now());
        head.headers.extend(now.ok().and_then(|now| now.parse().ok()).map(|now| (header::DATE, now)));
    }
    let ends = body.is_end_stream();
    if let (false, Some(length)) = (ends, body.size_hint().exact()) {
        head.headers.entry(header::CONTENT_LENGTH).or_insert_with(|| length.into());
    }
    // Fails only if the stream or the connection is gone.
    let stream = reply.send_response(Response::from_parts(head, ()), ends).ok()?;
    (!ends).then_some((Sender { stream, chunk: None }, body))
}

/// Removes headers that HTTP/2 forbids.
fn remove_connection_headers(headers: &mut HeaderMap) {
    for name in [header::CONNECTION, header::TRANSFER_ENCODING, header::UPGRADE] {
        headers.remove(name);
    }
}

/// Sends the body of a response, at most as fast as the caller takes it.
struct Sender {
    stream: SendStream<Bytes>,
    /// The chunk to send next, and whether it is the last one.
    chunk: Option<(Bytes, bool)>,
}

impl Sender {
    fn poll<B: Body<Data = Bytes>>(&mut self, context: &mut Context<'_>, mut body: Pin<&mut B>, exchange: &Exchange) -> Poll<()> {
        loop {
            if self.stream.poll_reset(context).is_ready() {
                return Poll::Ready(());
            }
            if exchange.stalled() {
                self.stream.send_reset(Reason::CANCEL);
                return Poll::Ready(());
            }
            if let Some((chunk, last)) = self.chunk.take() {
                match self.send(context, chunk, last, exchange) {
                    Poll::Ready(Some(())) => continue,
                    Poll::Ready(None) => return Poll::Ready(()),
                    Poll::Pending => return Poll::Pending,
                }
            }
            match ready!(body.as_mut().poll_frame(context)) {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.chunk = Some((data, body.is_end_stream())),
                    Err(frame) => {
                        let trailers = frame.into_trailers().unwrap_or_default();
                        self.stream.reserve_capacity(0);
                        // Fails only if the stream or the connection is gone, as below.
                        let _ = self.stream.send_trailers(trailers);
                        return Poll::Ready(());
                    }
                },
                Some(Err(_)) => {
                    self.stream.send_reset(Reason::INTERNAL_ERROR);
                    return Poll::Ready(());
                }
                None => {
                    let _ = self.stream.send_data(Bytes::new(), true);
                    return Poll::Ready(());
                }
            }
        }
    }

    /// Sends as much of the chunk as the windows permit. `None`: the response is complete, or the stream is gone.
    fn send(&mut self, context: &mut Context<'_>, mut chunk: Bytes, last: bool, exchange: &Exchange) -> Poll<Option<()>> {
        if !chunk.is_empty() {
            self.stream.reserve_capacity(chunk.len().min(MAX_SEND_BUFFER));
        }
        while !chunk.is_empty() && self.stream.capacity() == 0 {
            match self.stream.poll_capacity(context) {
                Poll::Ready(Some(Ok(_))) => {}
                Poll::Ready(_) => return Poll::Ready(None),
                Poll::Pending => {
                    exchange.blocked(context);
                    self.chunk = Some((chunk, last));
                    return Poll::Pending;
                }
            }
        }
        let ready = self.stream.capacity().min(chunk.len());
        let now = if ready < chunk.len() { chunk.split_to(ready) } else { std::mem::take(&mut chunk) };
        exchange.unblocked();
        let ends = last && chunk.is_empty();
        if self.stream.send_data(now, ends).is_err() || ends {
            return Poll::Ready(None);
        }
        if !chunk.is_empty() {
            self.chunk = Some((chunk, last));
        }
        Poll::Ready(Some(()))
    }
}
