//! What happens around every gRPC call: its deadline, its id and span, panics caught, statuses brought in line with the
//! table of errors, and its count. A call is over when its answer has gone out whole; then it is counted, with the status
//! that its trailers tell. A caller that leaves before that has cancelled it.

use std::convert::Infallible;
use std::error::Error as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use axum::http::{Request, Response};
use pin_project_lite::pin_project;
use tokio::time::Sleep;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use super::call::{Answer, Call, Question, Shared, in_line};
use super::deadline::{Deadline, stamp};
use super::meters::Meters;
use crate::api::observe::{Ids, REQUEST_ID, Valve, span};
use crate::service::Error;

/// Wraps all services.
#[derive(Clone)]
pub struct EnvelopeLayer(Arc<Shared>);

impl EnvelopeLayer {
    /// For the methods of these descriptor sets, until `closing` is cancelled.
    pub(super) fn new(descriptors: &[&[u8]], closing: CancellationToken) -> Self {
        Self(Arc::new(Shared { meters: Meters::new(descriptors), ids: Ids::new(), valve: Valve::new(), closing }))
    }
}

impl<S> Layer<S> for EnvelopeLayer {
    type Service = Envelope<S>;

    fn layer(&self, inner: S) -> Envelope<S> {
        Envelope { inner, shared: self.0.clone() }
    }
}

/// All services, wrapped.
#[derive(Clone)]
pub struct Envelope<S> {
    inner: S,
    shared: Arc<Shared>,
}

impl<S> Service<Request<Body>> for Envelope<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    type Response = Response<Answer>;
    type Error = Infallible;
    type Future = Answering<S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let mut request = stamp(request);
        let deadline = request.extensions().get::<Deadline>().map(|deadline| deadline.0);
        let number = self.shared.meters.find(request.uri().path());
        let method = self.shared.meters.method(number);
        let id = self.shared.ids.of(request.headers());
        let span = span(&method.path, method.quiet, &id, request.headers());
        let call = Call::begin(self.shared.clone(), number, id, span);
        method.handles().started.increment(1);
        if method.streams.client {
            request = request.map(|body| Body::new(Question::new(body, self.shared.clone(), number)));
        } else {
            method.handles().received.increment(1);
        }
        let work = call.span().in_scope(|| self.inner.call(request));
        Answering { work, deadline, sleep: None, call: Some(call) }
    }
}

pin_project! {
    /// A call that has no answer yet.
    pub struct Answering<F> {
        #[pin]
        work: F,
        deadline: Option<Instant>,
        #[pin]
        sleep: Option<Sleep>,
        // Taken by the answer.
        call: Option<Call>,
    }
}

impl<F> Future for Answering<F>
where
    F: Future<Output = Result<Response<Body>, Infallible>>,
{
    type Output = Result<Response<Answer>, Infallible>;

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let mut this = self.project();
        let Some(call) = this.call else { return Poll::Pending };
        // A deadline that has passed already is not worked for.
        if this.deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            return Poll::Ready(Ok(answer(too_late(), this.call)));
        }
        let inside = call.span().enter();
        let polled = catch_unwind(AssertUnwindSafe(|| this.work.poll(context)));
        drop(inside);
        let response = match polled {
            Ok(Poll::Ready(Ok(response))) => response,
            Ok(Poll::Pending) => {
                let Some(deadline) = *this.deadline else { return Poll::Pending };
                if this.sleep.is_none() {
                    this.sleep.set(Some(tokio::time::sleep_until(deadline.into())));
                }
                match this.sleep.as_mut().as_pin_mut().map(|sleep| sleep.poll(context)) {
                    Some(Poll::Ready(())) => too_late(),
                    _ => return Poll::Pending,
                }
            }
            Err(_) => Status::from(Error::internal("a handler panicked")).into_http(),
        };
        Poll::Ready(Ok(answer(response, this.call)))
    }
}

fn too_late() -> Response<Body> {
    Status::from(Error::Deadline("before the answer was ready")).into_http()
}

/// The answer as it is sent. One that is no more than a status ends the call; another ends it with its last byte.
fn answer(response: Response<Body>, call: &mut Option<Call>) -> Response<Answer> {
    let mut call = call.take().expect("a future that is ready is not polled again");
    // Generated code says only in a header that there is no such method.
    let told = || Status::from_header_map(response.headers());
    let status = response.extensions().get::<Status>().cloned().or_else(told);
    let in_line = status.as_ref().and_then(in_line);
    if let Some(status) = in_line.as_ref().or(status.as_ref()) {
        match status.source() {
            Some(cause) => call.end(status.code(), &cause),
            None => call.end(status.code(), &status.message()),
        }
    }
    let mut response = in_line.map(Status::into_http).unwrap_or(response);
    response.headers_mut().insert(REQUEST_ID, call.id().header());
    response.map(|body| Answer::new(body, call))
}
