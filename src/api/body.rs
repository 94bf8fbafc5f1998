//! Bodies of requests as they arrive, on both transports, and the state that a request and its response share.
//!
//! An HTTP/2 stream is received here and not by hyper, which reopens the flow-control window as soon as a frame is read. Here the
//! window opens when the bytes are used: a caller that sends faster than its requests are answered is slowed down. Frames that
//! arrive meanwhile are copied together, because HTTP/2 keeps some 200 bytes per frame, however small, and closes the connection
//! when there are too many.

use std::collections::VecDeque;
use std::error::Error as StdError;
use std::fmt;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker, ready};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use h2::{Reason, RecvStream};
use http_body::{Body, Frame, SizeHint};
use tokio::time::{Instant, Sleep};

use crate::inflight::{Exhausted, Holding, Purse};

/// Bytes per second below which a body or message is too slow, after the read timeout.
pub const MIN_RATE: u64 = 4 << 10;

/// Why a body ended early.
#[derive(Debug, thiserror::Error)]
pub enum BodyError {
    /// The budget of bytes in flight is exhausted.
    #[error(transparent)]
    Exhausted(#[from] Exhausted),
    /// The rest did not arrive in time.
    #[error("the rest did not arrive in time (at least {MIN_RATE} bytes per second after the read timeout)")]
    TooSlow,
    /// The caller broke off.
    #[error("{0}")]
    Broken(Box<dyn StdError + Send + Sync>),
}

/// Time limits of a request and its response.
#[derive(Clone, Copy, Debug)]
pub struct TimeLimits {
    /// Time for a body or message to arrive, beyond the time that its bytes take at [`MIN_RATE`].
    pub read: Duration,
    /// Time in which the caller must take some bytes of a response.
    pub write: Duration,
}

impl TimeLimits {
    /// Time for a body or message of which `bytes` have arrived.
    fn allowed(&self, bytes: usize) -> Duration {
        self.read + Duration::from_millis(bytes as u64 * 1000 / MIN_RATE)
    }
}

/// What a request and its response share: the bytes that they hold, and on HTTP/2 the stream.
pub struct Exchange {
    /// The bytes that the request and its response hold.
    pub holding: Holding,
    /// Whether the connection is from the reserve, which is only for probes.
    pub reserved: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// The request; none once it has ended or is not wanted any more, and on HTTP/1.
    stream: Option<RecvStream>,
    /// Bytes that arrived before they were wanted. The flow-control window does not open for them yet.
    buffer: BytesMut,
    failure: Option<BodyError>,
    /// Wakes whoever waits for the body.
    reader: Option<Waker>,
    /// Wakes the task that sends the response, if it waits for the caller to take bytes.
    writer: Option<Waker>,
    /// The body or message that is incomplete.
    part: Option<Part>,
    /// When the task was first seen waiting.
    blocked_since: Option<Duration>,
    stalled: bool,
    unanswered: VecDeque<Unanswered>,
    answered: u64,
}

/// A body or message that is incomplete.
#[derive(Default)]
struct Part {
    /// When it was first seen.
    since: Option<Duration>,
    bytes: usize,
}

/// Messages of a stream that have no response yet.
struct Unanswered {
    /// Number of messages in the stream up to the last of these.
    last: u64,
    bytes: usize,
}

impl fmt::Debug for Exchange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Exchange").field("holding", &self.holding).finish_non_exhaustive()
    }
}

impl Exchange {
    /// A request over HTTP/1.
    pub fn http1(purse: Arc<Purse>, reserved: bool) -> Arc<Self> {
        Arc::new(Self { holding: Holding::new(purse), reserved, state: Mutex::default() })
    }

    /// A request over HTTP/2. The body counts as one part until [`Exchange::between_parts`].
    pub fn http2(purse: Arc<Purse>, reserved: bool, stream: RecvStream) -> Arc<Self> {
        let state = if stream.is_end_stream() {
            State::default()
        } else {
            State { stream: Some(stream), part: Some(Part::default()), ..State::default() }
        };
        Arc::new(Self { holding: Holding::new(purse), reserved, state: Mutex::new(state) })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A message of a stream is incomplete: its time runs.
    pub fn begin_part(&self) {
        self.state().part.get_or_insert_default();
    }

    /// No message is incomplete: the stream may be silent.
    pub fn between_parts(&self) {
        self.state().part = None;
    }

    /// Remembers that `bytes`, which are held, belong to the messages of a stream up to number `last`.
    pub fn until_answered(&self, last: u64, bytes: usize) {
        self.state().unanswered.push_back(Unanswered { last, bytes });
    }

    /// Gives back the bytes of the messages that `responses` further responses belong to.
    pub fn answered(&self, responses: u64) {
        let mut state = self.state();
        state.answered += responses;
        while let Some(bytes) = state.unanswered.front().filter(|first| first.last <= state.answered).map(|first| first.bytes) {
            state.unanswered.pop_front();
            self.holding.shrink(bytes);
        }
    }

    /// Takes what has arrived of the body from the stream, so that HTTP/2 does not keep it frame by frame. Returns whether the
    /// task has to poll the reader again. To be called by the task of the request when it would otherwise wait.
    pub fn receive(&self, context: &mut Context<'_>) -> bool {
        let mut guard = self.state();
        let state = &mut *guard;
        let mut arrived = false;
        while let Some(stream) = &mut state.stream {
            match stream.poll_data(context) {
                Poll::Pending => break,
                Poll::Ready(Some(Ok(data))) => match self.holding.grow(data.len()) {
                    Ok(()) => state.buffer.extend_from_slice(&data),
                    Err(exhausted) => (state.stream, state.failure) = (None, Some(exhausted.into())),
                },
                Poll::Ready(end) => state.ended(end.and_then(Result::err)),
            }
            arrived = true;
        }
        let Some(reader) = state.reader.take_if(|_| arrived) else { return false };
        drop(guard);
        if reader.will_wake(context.waker()) {
            return true;
        }
        reader.wake();
        false
    }

    /// The task waits until the caller takes bytes of the response.
    pub fn blocked(&self, context: &Context<'_>) {
        self.state().writer = Some(context.waker().clone());
    }

    /// The caller took bytes of the response.
    pub fn unblocked(&self) {
        let mut state = self.state();
        (state.writer, state.blocked_since) = (None, None);
    }

    /// Whether the caller took no bytes of the response for too long.
    pub fn stalled(&self) -> bool {
        self.state().stalled
    }

    /// Applies the time limits. To be called regularly.
    pub fn check(&self, now: Duration, limits: &TimeLimits) {
        let mut state = self.state();
        // While bytes wait in the buffer, it is the server that is slow.
        let waiting = state.stream.is_some() && state.buffer.is_empty();
        if let Some(part) = state.part.as_mut().filter(|_| waiting) {
            let since = *part.since.get_or_insert(now);
            if now.saturating_sub(since) > limits.allowed(part.bytes) {
                (state.stream, state.failure) = (None, Some(BodyError::TooSlow));
            }
        }
        if state.writer.is_some() {
            let since = *state.blocked_since.get_or_insert(now);
            state.stalled = now.saturating_sub(since) > limits.write;
        }
        let failed = state.failure.is_some();
        let wakers = [state.reader.take_if(|_| failed), if state.stalled { state.writer.take() } else { None }];
        drop(state);
        wakers.into_iter().flatten().for_each(Waker::wake);
    }

    fn poll_data(&self, context: &mut Context<'_>) -> Poll<Option<Result<Bytes, BodyError>>> {
        let mut guard = self.state();
        let state = &mut *guard;
        if !state.buffer.is_empty() {
            let data = state.buffer.split().freeze();
            self.holding.shrink(data.len());
            return Poll::Ready(Some(Ok(state.passed_on(data))));
        }
        if let Some(failure) = state.failure.take() {
            return Poll::Ready(Some(Err(failure)));
        }
        let Some(stream) = &mut state.stream else { return Poll::Ready(None) };
        match stream.poll_data(context) {
            Poll::Pending => {
                if !state.reader.as_ref().is_some_and(|reader| reader.will_wake(context.waker())) {
                    state.reader = Some(context.waker().clone());
                }
                Poll::Pending
            }
            Poll::Ready(Some(Ok(data))) => Poll::Ready(Some(Ok(state.passed_on(data)))),
            Poll::Ready(end) => {
                state.ended(end.and_then(Result::err));
                Poll::Ready(state.failure.take().map(Err))
            }
        }
    }
}

impl State {
    /// Opens the flow-control window for bytes that are used now.
    fn passed_on(&mut self, data: Bytes) -> Bytes {
        if let Some(part) = &mut self.part {
            part.bytes += data.len();
        }
        if let Some(stream) = &mut self.stream {
            // Fails only if the caller has ended the stream.
            let _ = stream.flow_control().release_capacity(data.len());
        }
        data
    }

    /// Nothing more will arrive.
    fn ended(&mut self, error: Option<h2::Error>) {
        if let Some(mut stream) = self.stream.take() {
            // What is in the buffer must not narrow the window of the connection any longer.
            let _ = stream.flow_control().release_capacity(self.buffer.len());
        }
        // A reset with `NO_ERROR` ends the body without failing it.
        let error = error.filter(|error| error.reason() != Some(Reason::NO_ERROR));
        self.failure = error.map(|error| BodyError::Broken(error.into()));
    }
}

/// The body of a request.
pub struct IncomingBody {
    exchange: Arc<Exchange>,
    /// The body over HTTP/1; on HTTP/2 it is in the exchange.
    http1: Option<Pin<Box<Http1Body>>>,
}

struct Http1Body {
    body: Pin<Box<dyn Body<Data = Bytes, Error = BodyError> + Send>>,
    read_timeout: Duration,
    began: Instant,
    bytes: usize,
    deadline: Option<Pin<Box<Sleep>>>,
}

impl IncomingBody {
    /// The body of a request over HTTP/2.
    pub fn http2(exchange: Arc<Exchange>) -> Self {
        Self { exchange, http1: None }
    }

    /// The body of a request over HTTP/1.
    pub fn http1<B>(body: B, exchange: Arc<Exchange>, read_timeout: Duration) -> Self
    where
        B: Body<Data = Bytes> + Send + 'static,
        B::Error: Into<Box<dyn StdError + Send + Sync>>,
    {
        let body: Pin<Box<dyn Body<Data = Bytes, Error = BodyError> + Send>> = Box::pin(Mapped(Box::pin(body)));
        let began = Instant::now();
        Self { exchange, http1: Some(Box::pin(Http1Body { body, read_timeout, began, bytes: 0, deadline: None })) }
    }

    /// What the request shares with its response.
    pub fn exchange(&self) -> &Arc<Exchange> {
        &self.exchange
    }
}

impl Drop for IncomingBody {
    fn drop(&mut self) {
        // Nobody reads the rest.
        let mut state = self.exchange.state();
        let buffered = std::mem::take(&mut state.buffer).len();
        (state.stream, state.reader) = (None, None);
        drop(state);
        self.exchange.holding.shrink(buffered);
    }
}

impl Body for IncomingBody {
    type Data = Bytes;
    type Error = BodyError;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, BodyError>>> {
        match &mut self.http1 {
            Some(body) => body.as_mut().poll_frame(context),
            None => self.exchange.poll_data(context).map(|data| data.map(|data| data.map(Frame::data))),
        }
    }

    fn is_end_stream(&self) -> bool {
        if let Some(body) = &self.http1 {
            return body.body.is_end_stream();
        }
        let state = self.exchange.state();
        state.stream.is_none() && state.buffer.is_empty() && state.failure.is_none()
    }

    fn size_hint(&self) -> SizeHint {
        self.http1.as_ref().map_or_else(SizeHint::default, |body| body.body.size_hint())
    }
}

impl Http1Body {
    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, BodyError>>> {
        let this = self.get_mut();
        if let Poll::Ready(frame) = this.body.as_mut().poll_frame(context) {
            let data = frame.as_ref().and_then(|frame| frame.as_ref().ok()?.data_ref());
            this.bytes += data.map_or(0, Bytes::len);
            return Poll::Ready(frame);
        }
        let limits = TimeLimits { read: this.read_timeout, write: Duration::ZERO };
        let deadline = this.began + limits.allowed(this.bytes);
        let sleep = this.deadline.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(deadline)));
        if sleep.deadline() != deadline {
            sleep.as_mut().reset(deadline);
        }
        ready!(sleep.as_mut().poll(context));
        Poll::Ready(Some(Err(BodyError::TooSlow)))
    }
}

/// A body whose errors are [`BodyError`]s.
struct Mapped<B>(Pin<Box<B>>);

impl<B> Body for Mapped<B>
where
    B: Body<Data = Bytes>,
    B::Error: Into<Box<dyn StdError + Send + Sync>>,
{
    type Data = Bytes;
    type Error = BodyError;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, BodyError>>> {
        let frame = ready!(self.0.as_mut().poll_frame(context));
        Poll::Ready(frame.map(|frame| frame.map_err(|error| BodyError::Broken(error.into()))))
    }

    fn is_end_stream(&self) -> bool {
        self.0.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.0.size_hint()
    }
}
