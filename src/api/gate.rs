//! The gate in front of both transports: who shows which key, and whether that opens what is asked for (`access`).

use std::convert::Infallible;
use std::future::{Ready, ready};
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::extract::MatchedPath;
use axum::http::{Extensions, HeaderMap, HeaderName, Request, Response, header};
use axum::middleware::Next;
use axum::response::IntoResponse;
use futures::future::Either;
use tonic::Status;
use tonic::body::Body;
use tower::Service;

use super::access::{self, Need};
use crate::service::keys::Caller;
use crate::service::{App, Error};

/// gRPC services behind the gate.
#[derive(Clone)]
pub struct Gate<S> {
    inner: S,
    app: Arc<App>,
}

impl<S> Gate<S> {
    /// Puts the gate in front of `inner`.
    pub(super) fn new(inner: S, app: Arc<App>) -> Self {
        Self { inner, app }
    }
}

impl<S> Service<Request<Body>> for Gate<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = Either<S::Future, Ready<Result<Response<Body>, Infallible>>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        match admit(&self.app, &mut request, |request| access::grpc(request.uri().path())) {
            Ok(()) => Either::Left(self.inner.call(request)),
            Err(error) => Either::Right(ready(Ok(Status::from(error).into_http()))),
        }
    }
}

/// The gate of REST, for a request whose route is known.
pub(super) async fn around(app: Arc<App>, mut request: axum::extract::Request, next: Next) -> axum::response::Response {
    let rule = |request: &axum::extract::Request| {
        access::rest(request.method(), request.extensions().get::<MatchedPath>().map(MatchedPath::as_str))
    };
    match admit(&app, &mut request, rule) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

/// Lets a request in, or not. Who asks is put into its extensions; the secret is taken out of its headers.
fn admit<B>(app: &App, request: &mut Request<B>, need: impl FnOnce(&Request<B>) -> Need) -> Result<(), Error> {
    // All that it costs where nobody needs a key.
    if !app.keys.required() {
        return Ok(());
    }
    let need = need(request);
    if need == Need::Nothing {
        return Ok(());
    }
    let Some(caller) = app.keys.authenticate(presented(request.headers()), app.clock.now())? else { return Ok(()) };
    if let Need::Scope(scope) = need {
        caller.authorize(scope)?;
    }
    caller.acquire(&app.clock)?;
    tracing::Span::current().record("key", caller.id());
    request.headers_mut().remove(header::AUTHORIZATION);
    request.headers_mut().remove(API_KEY);
    request.extensions_mut().insert::<Caller>(caller);
    Ok(())
}

/// Who opened a stream; a key may end before the stream does.
#[derive(Clone)]
pub(super) struct Opener(Option<Caller>);

impl Opener {
    /// As the gate noted it. Nobody where no key is needed.
    pub(super) fn of(extensions: &Extensions) -> Self {
        Self(extensions.get().cloned())
    }

    /// Checks that the stream may still be answered.
    ///
    /// # Errors
    /// The key is over.
    pub(super) fn check(&self, app: &App) -> Result<(), Error> {
        self.0.as_ref().map_or(Ok(()), |caller| caller.check(app.clock.now()))
    }

    /// Counts the next message, which may be refused on its own: it comes too soon.
    ///
    /// # Errors
    /// The key is over, and the stream with it.
    pub(super) fn count(&self, app: &App) -> Result<Result<(), Error>, Status> {
        match self.0.as_ref().map_or(Ok(()), |caller| caller.check_and_acquire(&app.clock)) {
            Err(error) if !matches!(error, Error::Busy { .. }) => Err(error.into()),
            counted => Ok(counted),
        }
    }

    /// Counts what one message turned out to hold beyond itself.
    pub(super) fn charge(&self, app: &App, more: u32) {
        if let Some(caller) = &self.0 {
            caller.charge(more, &app.clock);
        }
    }
}

const API_KEY: HeaderName = HeaderName::from_static("x-api-key");

/// The key that a request shows.
fn presented(headers: &HeaderMap) -> Option<&str> {
    let bearer = || {
        let (scheme, key) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then_some(key.trim())
    };
    bearer().or_else(|| headers.get(API_KEY)?.to_str().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_found_in_both_headers() {
        let of = |pairs: &[(&str, &str)]| {
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.insert(HeaderName::try_from(*name).unwrap(), value.parse().unwrap());
            }
            presented(&headers).map(str::to_owned)
        };
        assert_eq!(of(&[("authorization", "Bearer k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "bearer  k ")]).as_deref(), Some("k"));
        assert_eq!(of(&[("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "Basic b"), ("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "Basic b")]), None);
        assert_eq!(of(&[("authorization", "k")]), None);
    }
}
