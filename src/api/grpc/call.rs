//! One gRPC call from its head to its last byte: the bodies of both directions, counted as they pass, and its end, told once.

use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use axum::http::{HeaderMap, header};
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::body::Body;
use tonic::{Code, Status};
use tracing::Span;

use super::meters::{Frames, Meters, Method, code_name};
use crate::api::observe::{Ending, Ids, RequestId, Valve, Verdict, tell};
use crate::invalid::Invalid;
use crate::service::Error;

/// What all calls share.
pub(super) struct Shared {
    pub(super) meters: Meters,
    pub(super) ids: Ids,
    pub(super) valve: Valve,
    /// Cancelled when the server closes.
    pub(super) closing: CancellationToken,
}

/// A call. It ends once: with a status, or cancelled when it is dropped before.
pub(super) struct Call {
    shared: Arc<Shared>,
    method: usize,
    id: RequestId,
    begun: Instant,
    span: Span,
    over: bool,
}

impl Call {
    /// One of method number `method` that begins now.
    pub(super) fn begin(shared: Arc<Shared>, method: usize, id: RequestId, span: Span) -> Self {
        Self { shared, method, id, begun: Instant::now(), span, over: false }
    }

    pub(super) fn id(&self) -> &RequestId {
        &self.id
    }

    pub(super) fn span(&self) -> &Span {
        &self.span
    }

    fn method(&self) -> &Method {
        self.shared.meters.method(self.method)
    }

    /// Counts it and says how it went.
    pub(super) fn end(&mut self, code: Code, detail: &dyn Display) {
        if std::mem::replace(&mut self.over, true) {
            return;
        }
        let method = self.method();
        let seconds = self.begun.elapsed().as_secs_f64();
        method.handled(code).increment(1);
        method.handles().seconds.record(seconds);
        let verdict = match code {
            Code::Internal | Code::Unknown | Code::DataLoss => Verdict::Fault,
            Code::ResourceExhausted | Code::DeadlineExceeded | Code::Unauthenticated | Code::PermissionDenied => Verdict::Refused,
            _ => Verdict::Settled,
        };
        let ending = Ending { method: &method.path, id: &self.id, code: code_name(code), seconds, verdict, detail };
        tell(&ending, &self.span, &self.shared.valve);
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        self.end(Code::Cancelled, &"the caller left");
    }
}

/// The transport has its own statuses for messages that are too large or do not decode; the table of errors has others.
pub(super) fn in_line(status: &Status) -> Option<Status> {
    if status.metadata().contains_key("qedgix-code") {
        return None;
    }
    Some(Status::from(match status.code() {
        Code::OutOfRange => Error::TooLarge(status.message().to_owned()),
        Code::Internal => Error::from(Invalid::new("message", status.message(), "one message of the method's request type")),
        _ => return None,
    }))
}

/// The body of a request of many messages. It ends when the server closes, however long its caller would go on, and with it
/// the stream that answers it.
pub(super) struct Question {
    body: Body,
    frames: Frames,
    shared: Arc<Shared>,
    method: usize,
    closing: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl Question {
    pub(super) fn new(body: Body, shared: Arc<Shared>, method: usize) -> Self {
        let closing = Box::pin(shared.closing.clone().cancelled_owned());
        Self { body, frames: Frames::default(), shared, method, closing }
    }
}

type Polled = Poll<Option<Result<Frame<Bytes>, Status>>>;

impl http_body::Body for Question {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Polled {
        let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) else {
            return self.closing.as_mut().poll(context).map(|()| None);
        };
        if let Some(piece) = frame.as_ref().and_then(|frame| frame.as_ref().ok()?.data_ref()) {
            let messages = self.frames.count(piece);
            self.shared.meters.method(self.method).handles().received.increment(messages);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The body of an answer; the call ends with it.
pub struct Answer {
    body: Body,
    frames: Frames,
    call: Call,
}

impl Answer {
    pub(super) fn new(body: Body, call: Call) -> Self {
        Self { body, frames: Frames::default(), call }
    }

    fn sent(&mut self, piece: &Bytes) {
        let method = self.call.method();
        let messages = if method.streams.server { self.frames.count(piece) } else { 1 };
        method.handles().sent.increment(messages);
    }

    /// The trailers tell how it went; they are brought in line, too.
    fn ended(&mut self, trailers: HeaderMap) -> HeaderMap {
        if trailers.get(Status::GRPC_STATUS).is_some_and(|code| code == "0") {
            self.call.end(Code::Ok, &"");
            return trailers;
        }
        let Some(status) = Status::from_header_map(&trailers) else {
            self.call.end(Code::Unknown, &"no status");
            return trailers;
        };
        match in_line(&status) {
            None => {
                self.call.end(status.code(), &status.message());
                trailers
            }
            Some(status) => {
                self.call.end(status.code(), &status.message());
                trailers_of(status)
            }
        }
    }
}

/// A status as it stands behind the messages.
fn trailers_of(status: Status) -> HeaderMap {
    let mut trailers = std::mem::take(status.into_http::<()>().headers_mut());
    trailers.remove(header::CONTENT_TYPE);
    trailers
}

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Polled {
        let this = &mut *self;
        let inside = this.call.span.enter();
        let polled = catch_unwind(AssertUnwindSafe(|| Pin::new(&mut this.body).poll_frame(context)));
        drop(inside);
        let Ok(polled) = polled else {
            this.body = Body::empty();
            let status = Status::from(Error::internal("a stream panicked"));
            this.call.end(status.code(), &"a stream panicked");
            return Poll::Ready(Some(Ok(Frame::trailers(trailers_of(status)))));
        };
        Poll::Ready(match ready!(polled) {
            Some(Ok(frame)) => Some(Ok(match frame.into_trailers() {
                Ok(trailers) => Frame::trailers(this.ended(trailers)),
                Err(frame) => {
                    if let Some(piece) = frame.data_ref() {
                        this.sent(piece);
                    }
                    frame
                }
            })),
            Some(Err(status)) => {
                this.call.end(status.code(), &status.message());
                Some(Err(status))
            }
            None => {
                // Trailers came before, or with the head.
                this.call.end(Code::Unknown, &"no status");
                None
            }
        })
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use http_body::Body as _;

    struct Panics;

    impl http_body::Body for Panics {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(self: Pin<&mut Self>, _: &mut Context<'_>) -> Polled {
            panic!("a stream of the tests panics")
        }
    }

    #[test]
    fn a_stream_that_panics_ends_with_a_status() {
        let shared = Shared { meters: Meters::new(&[]), ids: Ids::new(), valve: Valve::new(), closing: CancellationToken::new() };
        let id = shared.ids.of(&HeaderMap::new());
        let mut answer = Answer::new(Body::new(Panics), Call::begin(Arc::new(shared), 0, id, Span::none()));
        let mut context = Context::from_waker(std::task::Waker::noop());
        let Poll::Ready(Some(Ok(frame))) = Pin::new(&mut answer).poll_frame(&mut context) else { panic!("no frame") };
        let status = Status::from_header_map(frame.trailers_ref().unwrap()).unwrap();
        assert_eq!((status.code(), status.message()), (Code::Internal, "internal error"));
        assert!(answer.call.over && matches!(Pin::new(&mut answer).poll_frame(&mut context), Poll::Ready(None)));
    }
}
