//! The outermost middleware of gRPC. It admits the call to the budget of bytes in flight, applies the caller's deadline, assigns the request id, opens the span, catches
//! panics, adds an error code to statuses that have none, and logs and counts the call.
//!
//! A call ends when its last byte is sent, with the status in its trailers, or as cancelled if the client disconnects before.

use std::convert::Infallible;
use std::error::Error as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use axum::http::{HeaderMap, Request, Response};
use pin_project_lite::pin_project;
use tokio::time::Sleep;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tonic::body::Body;
use tower::Service;

use super::call::{Call, CallContext, ResponseBody, with_code};
use super::deadline::{Deadline, read_deadline};
use super::inflated_body::InflatedBody;
use super::metrics::Methods;
use super::request_body::RequestBody;
use crate::api::body::{Exchange, IncomingBody};
use crate::api::compression::Encoding;
use crate::api::is_probe;
use crate::api::request_log::{LogLimiter, REQUEST_ID, RequestIds, span};
use crate::causes;
use crate::inflight::Exhausted;
use crate::service::Error;

/// Services with this middleware.
#[derive(Clone)]
pub struct Middleware<S> {
    inner: S,
    context: Arc<CallContext>,
}

impl<S> Middleware<S> {
    /// Wraps services with these `methods`. Streams from clients end when `closing` is cancelled.
    pub(super) fn new(inner: S, methods: Methods, closing: CancellationToken) -> Self {
        let (ids, log_limiter) = (RequestIds::new(), LogLimiter::new());
        Self { inner, context: Arc::new(CallContext { methods, ids, log_limiter, closing }) }
    }
}

impl<S> Service<Request<IncomingBody>> for Middleware<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    type Response = Response<ResponseBody>;
    type Error = Infallible;
    type Future = ResponseFuture<S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<IncomingBody>) -> Self::Future {
        let mut request = read_deadline(request);
        let deadline = request.extensions().get::<Deadline>().map(|deadline| deadline.0);
        let number = self.context.methods.find(request.uri().path());
        let method = self.context.methods.get(number);
        let id = self.context.ids.for_request(request.headers());
        let span = span(&method.path, method.debug_span, &id, request.headers());
        let call = Call::begin(self.context.clone(), number, id, span);
        method.metrics().started.increment(1);
        if !method.streams.client {
            method.metrics().received.increment(1);
        }
        let exchange = request.body().exchange().clone();
        // Only probes have a place in the reserve of connections.
        let admitted = if exchange.reserved && !is_probe(request.uri().path()) {
            Err(Exhausted)
        } else {
            exchange.holding.admit(method.class)
        };
        let encoding = if method.compressed { take_encoding(request.headers_mut()) } else { None };
        let work = admitted.is_ok().then(|| {
            let request = request.map(|body| {
                let body = RequestBody::new(body, self.context.clone(), number, encoding.is_some());
                match encoding {
                    None => Body::new(body),
                    Some(encoding) => Body::new(InflatedBody::new(body, exchange.clone(), encoding, method.limit)),
                }
            });
            call.span().in_scope(|| self.inner.call(request))
        });
        ResponseFuture { work, deadline, sleep: None, call: Some(call), exchange }
    }
}

/// Removes the encoding of compressed messages from the headers, because they are inflated before tonic sees them. Leaves encodings
/// that are not supported, which tonic refuses.
fn take_encoding(headers: &mut HeaderMap) -> Option<Encoding> {
    let encoding = Encoding::parse(headers.get(ENCODING)?.to_str().ok()?)?;
    headers.remove(ENCODING);
    Some(encoding)
}

const ENCODING: &str = "grpc-encoding";

pin_project! {
    /// The head of the response to a call, or the error if the deadline passes first.
    pub struct ResponseFuture<F> {
        // None if the call is not admitted.
        #[pin]
        work: Option<F>,
        deadline: Option<Instant>,
        #[pin]
        sleep: Option<Sleep>,
        // Moved to the body of the response.
        call: Option<Call>,
        exchange: Arc<Exchange>,
    }
}

impl<F> Future for ResponseFuture<F>
where
    F: Future<Output = Result<Response<Body>, Infallible>>,
{
    type Output = Result<Response<ResponseBody>, Infallible>;

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let mut this = self.project();
        let Some(call) = this.call else { return Poll::Pending };
        // No work starts after the deadline.
        if this.deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            return Poll::Ready(Ok(respond(deadline_exceeded(), this.call, this.exchange)));
        }
        let Some(work) = this.work.as_pin_mut() else {
            return Poll::Ready(Ok(respond(Status::from(Error::Overloaded).into_http(), this.call, this.exchange)));
        };
        let inside = call.span().enter();
        let polled = catch_unwind(AssertUnwindSafe(|| work.poll(context)));
        drop(inside);
        let response = match polled {
            Ok(Poll::Ready(Ok(response))) => response,
            Ok(Poll::Pending) => {
                let Some(deadline) = *this.deadline else { return Poll::Pending };
                if this.sleep.is_none() {
                    this.sleep.set(Some(tokio::time::sleep_until(deadline.into())));
                }
                match this.sleep.as_mut().as_pin_mut().map(|sleep| sleep.poll(context)) {
                    Some(Poll::Ready(())) => deadline_exceeded(),
                    _ => return Poll::Pending,
                }
            }
            Err(_) => Status::from(Error::internal("a handler panicked")).into_http(),
        };
        Poll::Ready(Ok(respond(response, this.call, this.exchange)))
    }
}

fn deadline_exceeded() -> Response<Body> {
    Status::from(Error::Deadline("before the response was ready")).into_http()
}

/// Completes the response. If it is only a status, the call ends here; otherwise it ends with the last byte of the body.
fn respond(response: Response<Body>, call: &mut Option<Call>, exchange: &Arc<Exchange>) -> Response<ResponseBody> {
    let mut call = call.take().expect("a future that is ready is not polled again");
    // tonic reports an unknown method in the headers only.
    let in_headers = || Status::from_header_map(response.headers());
    let status = response.extensions().get::<Status>().cloned().or_else(in_headers);
    let replaced = status.as_ref().and_then(with_code);
    if let Some(status) = replaced.as_ref().or(status.as_ref()) {
        match status.source() {
            Some(cause) => call.end(status.code(), &causes::text(cause)),
            None => call.end(status.code(), &status.message()),
        }
    }
    let mut response = replaced.map(Status::into_http).unwrap_or(response);
    response.headers_mut().insert(REQUEST_ID, call.id().header());
    response.map(|body| ResponseBody::new(body, call, exchange.clone()))
}
