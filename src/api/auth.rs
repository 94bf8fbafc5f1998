//! Authentication and authorization of both transports. A request passes if its API key has what `access` requires for the
//! method or route.

use std::convert::Infallible;
use std::future::{Ready, ready};
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::extract::{FromRequestParts, MatchedPath};
use axum::http::request::Parts;
use axum::http::{Extensions, HeaderMap, HeaderName, Request, Response, header};
use axum::middleware::Next;
use axum::response::IntoResponse;
use futures::future::Either;
use tonic::Status;
use tonic::body::Body;
use tower::Service;

use super::access::{self, Requirement};
use super::browser::{self, AllowedHosts};
use crate::service::keys::{Caller, Scope};
use crate::service::{App, Error};

/// gRPC services that authorize every call.
#[derive(Clone)]
pub struct Authorized<S> {
    inner: S,
    app: Arc<App>,
}

impl<S> Authorized<S> {
    /// Authorizes calls before they reach `inner`.
    pub(super) fn new(inner: S, app: Arc<App>) -> Self {
        Self { inner, app }
    }
}

impl<S> Service<Request<Body>> for Authorized<S>
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
        let requirement = |request: &Request<Body>| access::grpc_requirement(request.uri().path());
        let foreign = |request: &Request<Body>| browser::check_grpc(request.headers());
        match authorize(&self.app, &mut request, requirement, foreign) {
            Ok(()) => Either::Left(self.inner.call(request)),
            Err(error) => Either::Right(ready(Ok(Status::from(error).into_http()))),
        }
    }
}

/// Middleware that authorizes REST requests. It runs after routing.
pub(super) async fn authorize_rest(
    app: Arc<App>,
    hosts: Arc<AllowedHosts>,
    mut request: axum::extract::Request,
    next: Next,
) -> axum::response::Response {
    let requirement = |request: &axum::extract::Request| {
        access::rest_requirement(request.method(), request.extensions().get::<MatchedPath>().map(MatchedPath::as_str))
    };
    let authorized = authorize(&app, &mut request, requirement, |request| hosts.check(request));
    match authorized.and_then(|()| browser::check_media_type(&request)) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

/// Authenticates the caller, counts the request against the rate of the key and checks the scope, in this order: a request
/// without the required scope counts like any other. Moves the key from the headers to a [`Caller`] in the extensions. On a server
/// without keys, `check_foreign` refuses what pages of other sites send. A replica refuses changes.
fn authorize<B>(
    app: &App,
    request: &mut Request<B>,
    requirement: impl FnOnce(&Request<B>) -> Requirement,
    check_foreign: impl FnOnce(&Request<B>) -> Result<(), Error>,
) -> Result<(), Error> {
    if !app.keys.required() {
        check_foreign(request)?;
        return refuse_changes(app, || requirement(request));
    }
    let requirement = requirement(request);
    if requirement == Requirement::NoKey {
        return Ok(());
    }
    let caller = app.keys.authenticate(presented_key(request.headers()), app.clock.now())?;
    tracing::Span::current().record("key", caller.key_id());
    caller.acquire(&app.clock)?;
    if let Requirement::Scope(scope) = requirement {
        caller.authorize(scope)?;
    }
    refuse_changes(app, || requirement)?;
    request.headers_mut().remove(header::AUTHORIZATION);
    request.headers_mut().remove(API_KEY);
    request.extensions_mut().insert::<Caller>(caller);
    Ok(())
}

/// Refuses what a replica leaves to its primary: changes of policies, and jobs.
fn refuse_changes(app: &App, requirement: impl FnOnce() -> Requirement) -> Result<(), Error> {
    let Some(replica) = &app.replica else { return Ok(()) };
    match requirement() {
        Requirement::Scope(Scope::Admin | Scope::Jobs) => Err(Error::ReadOnly { primary: replica.primary().to_owned() }),
        _ => Ok(()),
    }
}

/// The caller of a request, as [`authorize`] put it into the extensions.
pub(super) fn caller(extensions: &Extensions) -> Caller {
    extensions.get().cloned().unwrap_or_default()
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(caller(&parts.extensions))
    }
}

/// Counts the next message of a stream against the rate of its caller, whose key may expire or be revoked before the stream ends.
/// The inner error refuses this message only.
///
/// # Errors
/// The status that ends the stream, if the key expired or was revoked.
pub(super) fn count_message(caller: &Caller, app: &App) -> Result<Result<(), Error>, Status> {
    match caller.check_and_acquire(&app.clock) {
        Err(error) if !matches!(error, Error::Busy { .. }) => Err(error.into()),
        counted => Ok(counted),
    }
}

const API_KEY: HeaderName = HeaderName::from_static("x-api-key");

/// The API key in the headers of a request.
fn presented_key(headers: &HeaderMap) -> Option<&str> {
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
    fn keys_are_read_from_both_headers() {
        let key_of = |pairs: &[(&str, &str)]| {
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.insert(HeaderName::try_from(*name).unwrap(), value.parse().unwrap());
            }
            presented_key(&headers).map(str::to_owned)
        };
        assert_eq!(key_of(&[("authorization", "Bearer k")]).as_deref(), Some("k"));
        assert_eq!(key_of(&[("authorization", "bearer  k ")]).as_deref(), Some("k"));
        assert_eq!(key_of(&[("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(key_of(&[("authorization", "Basic b"), ("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(key_of(&[("authorization", "Basic b")]), None);
        assert_eq!(key_of(&[("authorization", "k")]), None);
    }
}
