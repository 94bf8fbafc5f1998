//! One gRPC call: the body of its response, whose messages are counted, and its end, which is logged once.

use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use axum::http::{HeaderMap, header};
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio_util::sync::CancellationToken;
use tonic::body::Body;
use tonic::{Code, Status};
use tracing::Span;

use super::metrics::{MessageCounter, Method, Methods, code_name};
use crate::api::body::Exchange;
use crate::api::errors::CODE_METADATA;
use crate::api::request_log::{Completion, LogLimiter, RequestId, RequestIds, Severity, log_request};
use crate::inflight::Exhausted;
use crate::invalid::Invalid;
use crate::service::Error;

/// The state that all calls share.
pub(super) struct CallContext {
    pub(super) methods: Methods,
    pub(super) ids: RequestIds,
    pub(super) log_limiter: LogLimiter,
    /// Cancelled when the server closes.
    pub(super) closing: CancellationToken,
}

/// A call. It ends once: with a status, or as cancelled if it is dropped before.
pub(super) struct Call {
    context: Arc<CallContext>,
    method: usize,
    id: RequestId,
    started: Instant,
    span: Span,
    ended: bool,
}

impl Call {
    /// A call of method number `method` that starts now.
    pub(super) fn begin(context: Arc<CallContext>, method: usize, id: RequestId, span: Span) -> Self {
        Self { context, method, id, started: Instant::now(), span, ended: false }
    }

    pub(super) fn id(&self) -> &RequestId {
        &self.id
    }

    pub(super) fn span(&self) -> &Span {
        &self.span
    }

    fn method(&self) -> &Method {
        self.context.methods.get(self.method)
    }

    /// Counts and logs the call. Later calls of this function do nothing.
    pub(super) fn end(&mut self, code: Code, detail: &dyn Display) {
        if std::mem::replace(&mut self.ended, true) {
            return;
        }
        let method = self.method();
        let seconds = self.started.elapsed().as_secs_f64();
        method.completed(code).increment(1);
        method.metrics().seconds.record(seconds);
        let severity = match code {
            Code::Internal | Code::Unknown | Code::DataLoss => Severity::Failed,
            Code::ResourceExhausted | Code::DeadlineExceeded | Code::Unauthenticated | Code::PermissionDenied => {
                Severity::Refused
            }
            _ => Severity::Normal,
        };
        let completion = Completion { method: &method.path, id: &self.id, code: code_name(code), seconds, severity, detail };
        log_request(&completion, &self.span, &self.context.log_limiter);
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        self.end(Code::Cancelled, &"cancelled by the client");
    }
}

/// The replacement for a status that tonic created and that therefore has no [`ErrorCode`](crate::error_code::ErrorCode): the
/// message is too large or cannot be decoded. `None` if the status needs no replacement.
pub(super) fn with_code(status: &Status) -> Option<Status> {
    if status.metadata().contains_key(CODE_METADATA) {
        return None;
    }
    Some(Status::from(match status.code() {
        Code::OutOfRange => Error::TooLarge { message: status.message().to_owned(), limit: None },
        Code::Internal => Error::from(Invalid::new("message", status.message(), "a message of the request type of the method")),
        // An unknown method has no message.
        Code::Unimplemented if status.message().contains("compressed") => {
            let encoding = status.message().split('`').nth(1).unwrap_or("an encoding");
            Error::MediaType(Invalid::new(
                "grpc-encoding",
                encoding,
                "identity, or for the Open Inference Protocol also gzip or deflate",
            ))
        }
        _ => return None,
    }))
}

type Polled = Poll<Option<Result<Frame<Bytes>, Status>>>;

/// The body of a response. The call ends with its last frame.
pub struct ResponseBody {
    body: Body,
    messages: MessageCounter,
    call: Call,
    exchange: Arc<Exchange>,
    /// Bytes of the last frame, which are held until the next one is wanted.
    last: usize,
}

impl ResponseBody {
    pub(super) fn new(body: Body, call: Call, exchange: Arc<Exchange>) -> Self {
        Self { body, messages: MessageCounter::default(), call, exchange, last: 0 }
    }

    /// Counts a frame. Fails if the budget of bytes in flight has no room for it.
    fn sent(&mut self, piece: &Bytes) -> Result<(), Exhausted> {
        self.exchange.holding.grow(piece.len())?;
        self.last = piece.len();
        let method = self.call.method();
        let messages = if method.streams.server { self.messages.count(piece) } else { 1 };
        method.metrics().sent.increment(messages);
        if method.streams.server && method.streams.client {
            self.exchange.answered(messages);
        }
        Ok(())
    }

    /// Ends the response with an error instead of the rest.
    fn break_off(&mut self, error: Error) -> Frame<Bytes> {
        self.body = Body::empty();
        let status = Status::from(error);
        self.call.end(status.code(), &status.message());
        Frame::trailers(trailers_of(status))
    }

    /// Ends the call with the status in the trailers, and adds the error code if it is missing.
    fn ended(&mut self, trailers: HeaderMap) -> HeaderMap {
        if trailers.get(Status::GRPC_STATUS).is_some_and(|code| code == "0") {
            self.call.end(Code::Ok, &"");
            return trailers;
        }
        let Some(status) = Status::from_header_map(&trailers) else {
            self.call.end(Code::Unknown, &"no status");
            return trailers;
        };
        match with_code(&status) {
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

/// The trailers of a status.
fn trailers_of(status: Status) -> HeaderMap {
    let mut trailers = std::mem::take(status.into_http::<()>().headers_mut());
    trailers.remove(header::CONTENT_TYPE);
    trailers
}

impl http_body::Body for ResponseBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Polled {
        let this = &mut *self;
        this.exchange.holding.shrink(std::mem::take(&mut this.last));
        let inside = this.call.span.enter();
        let polled = catch_unwind(AssertUnwindSafe(|| Pin::new(&mut this.body).poll_frame(context)));
        drop(inside);
        let Ok(polled) = polled else {
            this.call.end(Code::Internal, &"a stream panicked");
            return Poll::Ready(Some(Ok(this.break_off(Error::internal("a stream panicked")))));
        };
        Poll::Ready(match ready!(polled) {
            Some(Ok(frame)) => Some(Ok(match frame.into_trailers() {
                Ok(trailers) => Frame::trailers(this.ended(trailers)),
                Err(frame) => match frame.data_ref().map_or(Ok(()), |piece| this.sent(piece)) {
                    Ok(()) => frame,
                    Err(exhausted) => this.break_off(exhausted.into()),
                },
            })),
            Some(Err(status)) => {
                this.call.end(status.code(), &status.message());
                Some(Err(status))
            }
            None => {
                // The trailers came before, or the response had only a head.
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
    use crate::inflight::{Budget, Purse};
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
    fn a_panic_in_a_stream_ends_it_with_a_status() {
        let (methods, closing) = (Methods::new(&[], 1024), CancellationToken::new());
        let context = CallContext { methods, ids: RequestIds::new(), log_limiter: LogLimiter::new(), closing };
        let id = context.ids.for_request(&HeaderMap::new());
        let call = Call::begin(Arc::new(context), 0, id, Span::none());
        let exchange = Exchange::http1(Purse::new(Budget::new(Budget::MIN)), false);
        let mut body = ResponseBody::new(Body::new(Panics), call, exchange);
        let mut context = Context::from_waker(std::task::Waker::noop());
        let Poll::Ready(Some(Ok(frame))) = Pin::new(&mut body).poll_frame(&mut context) else { panic!("no frame") };
        let status = Status::from_header_map(frame.trailers_ref().unwrap()).unwrap();
        assert_eq!((status.code(), status.message()), (Code::Internal, "internal error"));
        assert!(body.call.ended && matches!(Pin::new(&mut body).poll_frame(&mut context), Poll::Ready(None)));
    }
}
