//! Calls with a large message are decoded and handled on the background thread, so that calls with small ones never wait for that: to
//! decode a scene of ten thousand users takes milliseconds.

use std::collections::HashSet;
use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use axum::http::request::Parts;
use axum::http::{Request, Response};
use bytes::Bytes;
use http_body::{Body as _, Frame};
use pin_project_lite::pin_project;
use tokio::runtime::Handle;
use tokio_util::task::AbortOnDropHandle;
use tonic::Status;
use tonic::body::Body;
use tower::Service;
use tracing::Instrument;

use crate::service::Error;

/// Bytes from which a message is large.
const LARGE: usize = 1 << 16;

/// Services that handle calls with a large message on another thread. Calls whose client streams are handled where they arrive.
#[derive(Clone)]
pub struct LargeMessages<S> {
    inner: S,
    /// Paths of the methods whose client streams.
    streams: Arc<HashSet<String>>,
    background: Handle,
}

impl<S> LargeMessages<S> {
    /// `streams`: paths of the methods whose client streams.
    pub(super) fn new(inner: S, streams: HashSet<String>, background: Handle) -> Self {
        Self { inner, streams: Arc::new(streams), background }
    }
}

impl<S> Service<Request<Body>> for LargeMessages<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible, Future: Send> + Clone + Send + 'static,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = Arriving<S, S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        if self.streams.contains(request.uri().path()) {
            return Arriving::Here { work: self.inner.call(request) };
        }
        let (head, body) = request.into_parts();
        Arriving::Message { call: Some((self.inner.clone(), head, body)), background: self.background.clone() }
    }
}

pin_project! {
    /// A call whose message arrives, and then its answer.
    #[project = Project]
    pub enum Arriving<S, F> {
        Message { call: Option<(S, Parts, Body)>, background: Handle },
        Here { #[pin] work: F },
        Background { work: AbortOnDropHandle<Result<Response<Body>, Infallible>> },
    }
}

impl<S> Future for Arriving<S, S::Future>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible, Future: Send> + Send + 'static,
{
    type Output = Result<Response<Body>, Infallible>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        loop {
            let next = match self.as_mut().project() {
                Project::Here { work } => return work.poll(context),
                Project::Background { work } => {
                    let done = ready!(Pin::new(work).poll(context));
                    return Poll::Ready(
                        done.unwrap_or_else(|_| Ok(Status::from(Error::internal("a handler panicked")).into_http())),
                    );
                }
                Project::Message { call, background } => {
                    let (_, _, body) = call.as_mut().expect("taken only when the state changes");
                    let first = ready!(Pin::new(body).poll_frame(context));
                    let (mut inner, head, rest) = call.take().expect("it was there");
                    let large = matches!(&first, Some(Ok(frame)) if frame.data_ref().is_some_and(|data| data.len() >= LARGE));
                    let request = Request::from_parts(head, Body::new(Replayed { first: Some(first), rest }));
                    if large {
                        let work = async move { inner.call(request).await }.in_current_span();
                        Arriving::Background { work: AbortOnDropHandle::new(background.spawn(work)) }
                    } else {
                        Arriving::Here { work: inner.call(request) }
                    }
                }
            };
            self.set(next);
        }
    }
}

/// A body whose first frame was taken.
struct Replayed {
    first: Option<Option<Result<Frame<Bytes>, Status>>>,
    rest: Body,
}

impl http_body::Body for Replayed {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        match self.first.take() {
            Some(first) => Poll::Ready(first),
            None => Pin::new(&mut self.rest).poll_frame(context),
        }
    }
}
