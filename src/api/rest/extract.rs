//! Extractors of bodies, paths and queries whose rejections are errors of the service.

use std::error::Error as _;
use std::iter;
use std::sync::Arc;

use axum::body::BodyDataStream;
use axum::extract::rejection::QueryRejection;
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, header};
use bytes::Bytes;
use futures::StreamExt;
use jiff::Timestamp;
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};
use uuid::Uuid;

use crate::api::body::Exchange;
use crate::api::compression::{Encoding, Inflater};
pub use crate::api::json::parse;
pub use crate::api::media_type::{media_type, unsupported};
use crate::api::offload;
use crate::invalid::{Invalid, expectation};
use crate::service::Error;

/// Maximum size of a body, in bytes.
#[derive(Clone, Copy, Debug)]
pub struct MaxBody(pub usize);

/// This much of a body that is too large is read and discarded, so that a caller that is still sending gets the response instead
/// of a broken connection.
const DISCARDED: usize = 64 << 20;

/// A body that is a JSON document of type `T`.
#[derive(Debug)]
pub struct Json<T>(pub T);

/// A larger body is parsed on a thread of its own.
const LARGE_BODY: usize = 64 << 10;

impl<S: Sync, T: DeserializeOwned + Send + 'static> FromRequest<S> for Json<T> {
    type Rejection = Error;

    async fn from_request(request: Request, _: &S) -> Result<Self, Error> {
        match media_type(request.headers()) {
            Some(kind) if kind == "application/json" => {}
            kind => return Err(unsupported(kind, "application/json")),
        }
        let limit = limit(&request);
        let body = read(request, limit).await?;
        offload(body.len() > LARGE_BODY, move || parse(&body).map(Self)).await?
    }
}

/// A body as it is sent, of any content type.
#[derive(Debug)]
pub struct Raw(pub Bytes);

impl<S: Sync> FromRequest<S> for Raw {
    type Rejection = Error;

    async fn from_request(request: Request, _: &S) -> Result<Self, Error> {
        let limit = limit(&request);
        read(request, limit).await.map(Self)
    }
}

fn limit(request: &Request) -> usize {
    request.extensions().get().map_or(4 << 20, |&MaxBody(limit)| limit)
}

/// A body that may be compressed, inflated.
#[derive(Debug)]
pub struct Inflated(pub Bytes);

impl<S: Sync> FromRequest<S> for Inflated {
    type Rejection = Error;

    async fn from_request(request: Request, _: &S) -> Result<Self, Error> {
        let limit = limit(&request);
        let encoding = request.headers().get(header::CONTENT_ENCODING).and_then(|name| Encoding::parse(name.to_str().ok()?));
        let Some(encoding) = encoding else { return read(request, limit).await.map(Self) };
        let exchange = request.extensions().get::<Arc<Exchange>>().cloned();
        let body = read_encoded(request, limit).await?;
        // A few bytes may inflate to many.
        offload(true, move || inflate(body, (encoding, limit), exchange.as_deref())).await?.map(Self)
    }
}

/// Inflates a body. What it inflates to counts against the budget of bytes in flight.
fn inflate(body: Bytes, (encoding, limit): (Encoding, usize), exchange: Option<&Exchange>) -> Result<Bytes, Error> {
    let mut inflater = Inflater::new(encoding, body, &[], limit);
    loop {
        let bytes = inflater.step()?;
        if bytes == 0 {
            return Ok(inflater.finish().freeze());
        }
        if let Some(exchange) = exchange {
            exchange.holding.grow(bytes)?;
        }
    }
}

/// Reads a body of at most `limit` bytes.
///
/// # Errors
/// [`Error::TooLarge`]; [`Error::MediaType`] where the body is compressed; [`Error::Invalid`] where it is incomplete;
/// [`Error::Overloaded`] where the budget of bytes in flight has no room for it.
pub async fn read(request: Request, limit: usize) -> Result<Bytes, Error> {
    check_encoding(request.headers())?;
    read_encoded(request, limit).await
}

/// As [`read`], whatever the encoding.
async fn read_encoded(request: Request, limit: usize) -> Result<Bytes, Error> {
    let too_large =
        || Error::TooLarge { message: format!("the body is larger than the limit of {limit} bytes"), limit: Some(limit as u64) };
    let announced = announced_size(request.headers());
    // A caller that asks first sends nothing after the refusal.
    let asks = request.headers().contains_key(header::EXPECT);
    let exchange = request.extensions().get::<Arc<Exchange>>().cloned();
    let mut body = request.into_body().into_data_stream();
    if announced > limit as u64 {
        // More than is discarded breaks the connection in any case.
        if !asks && announced <= DISCARDED as u64 {
            discard(body).await;
        }
        return Err(too_large());
    }
    // The buffer grows with what arrives, not with what is announced.
    let mut received = bytes::BytesMut::with_capacity((announced as usize).min(FIRST_BUFFER));
    while let Some(part) = body.next().await {
        let part = part.map_err(|e| Invalid::new("body", e, "a complete body"))?;
        if let Some(exchange) = &exchange {
            exchange.holding.grow(part.len())?;
        }
        if received.len() + part.len() > limit {
            discard(body).await;
            return Err(too_large());
        }
        received.extend_from_slice(&part);
    }
    Ok(received.freeze())
}

/// Size of the buffer for a body, before it grows.
const FIRST_BUFFER: usize = 8 << 10;

/// Refuses compressed bodies.
fn check_encoding(headers: &HeaderMap) -> Result<(), Error> {
    let encodings = headers.get_all(header::CONTENT_ENCODING).iter().map(|value| value.to_str().unwrap_or("unreadable"));
    match encodings.flat_map(|value| value.split(',')).map(str::trim).find(|name| !name.eq_ignore_ascii_case("identity")) {
        None => Ok(()),
        Some(name) => Err(Error::MediaType(Invalid::new("content-encoding", name, "identity: a body without compression"))),
    }
}

/// Size of the body by its header, 0 when the header is missing. A body that differs is rejected by HTTP, or by the limit.
fn announced_size(headers: &HeaderMap) -> u64 {
    headers.get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok()).unwrap_or(0)
}

async fn discard(mut parts: BodyDataStream) {
    let mut remaining = DISCARDED;
    while let Some(Ok(part)) = parts.next().await {
        match remaining.checked_sub(part.len()) {
            Some(rest) => remaining = rest,
            None => return,
        }
    }
}

/// The parameters of a path.
#[derive(Debug)]
pub struct Path<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for Path<T> {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Error> {
        let read = axum::extract::Path::<T>::from_request_parts(parts, state).await;
        match read {
            Ok(path) => Ok(Self(path.0)),
            Err(e) => Err(Invalid::new("path", parts.uri.path(), e.body_text()).into()),
        }
    }
}

/// The query.
#[derive(Debug)]
pub struct Query<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Query<T> {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Error> {
        let read = axum::extract::Query::<T>::from_request_parts(parts, state).await;
        match read {
            Ok(query) => Ok(Self(query.0)),
            Err(e) => Err(invalid_query(&e, parts.uri.query().unwrap_or("")).into()),
        }
    }
}

/// What is wrong with `query`: the parameter that cannot be read, or the query where it has a parameter that does not exist or
/// misses one.
fn invalid_query(rejection: &QueryRejection, query: &str) -> Invalid {
    type Unreadable = serde_path_to_error::Error<serde::de::value::Error>;
    let unreadable = iter::successors(rejection.source(), |&e| e.source()).find_map(|e| e.downcast_ref::<Unreadable>());
    let named = unreadable.and_then(|e| {
        let (name, message) = (e.path().to_string(), e.inner().to_string());
        if message.starts_with("unknown field") {
            return Some(Invalid::unknown_parameter(name, expectation(&message)));
        }
        // These belong to the whole query, so only the message names the parameter.
        let quoted = message.split('`').nth(1);
        if message.starts_with("missing field") {
            return Some(Invalid::missing(quoted?, "a value"));
        }
        if message.starts_with("duplicate field") {
            return Some(Invalid::new(quoted?, "two values", "one"));
        }
        let (_, value) = query.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, ""))).find(|(key, _)| *key == name)?;
        Some(Invalid::new(name, value, expected_value(&message)))
    });
    named.unwrap_or_else(|| Invalid::new("query", query, rejection.body_text()))
}

/// What a parser of the value of a parameter expected.
fn expected_value(message: &str) -> String {
    match message {
        "invalid digit found in string" | "cannot parse integer from empty string" | "number too small to fit in target type" => {
            "a whole number, 0 or more".to_owned()
        }
        "number too large to fit in target type" => "a smaller number".to_owned(),
        "provided string was not `true` or `false`" => "true or false".to_owned(),
        _ => expectation(&message),
    }
}

/// Reads a parameter that is a time.
///
/// # Errors
/// It is not a time in the form of RFC 3339.
pub fn time<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Timestamp>, D::Error> {
    let time = String::deserialize(deserializer)?.parse();
    time.map(Some).map_err(|_| D::Error::custom("expected a time such as 2026-01-31T12:00:00Z"))
}

/// Reads a parameter that is the id of a job.
///
/// # Errors
/// It is not a UUID.
pub fn job_id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Uuid>, D::Error> {
    let id = String::deserialize(deserializer)?.parse();
    id.map(Some).map_err(|_| D::Error::custom("expected the id of a job"))
}

#[cfg(test)]
mod tests {
    use std::thread::{self, ThreadId};

    use serde::de::IgnoredAny;

    use crate::store::JobState;

    use super::*;

    /// The thread that parsed a body.
    struct ParsedOn(ThreadId);

    impl<'de> Deserialize<'de> for ParsedOn {
        fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
            IgnoredAny::deserialize(deserializer)?;
            Ok(Self(thread::current().id()))
        }
    }

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    #[expect(dead_code, reason = "only its errors are read")]
    struct Parameters {
        state: Option<JobState>,
        #[serde(default, deserialize_with = "time")]
        created_after: Option<Timestamp>,
        #[serde(default, deserialize_with = "job_id")]
        parent: Option<Uuid>,
        #[serde(default)]
        page_size: u32,
        needed: bool,
    }

    #[tokio::test]
    async fn errors_of_queries_are_sentences() {
        for (query, message) in [
            ("state=foo", "state: got foo, expected one of queued, running, paused, cancelled, succeeded, failed"),
            (
                "state=failled",
                "state: got failled, expected one of queued, running, paused, cancelled, succeeded, failed; did you mean failed?",
            ),
            ("page_size=-1", "page_size: got -1, expected a whole number, 0 or more"),
            ("page_size=99999999999", "page_size: got 99999999999, expected a smaller number"),
            ("page_size=1&page_size=2", "page_size: got two values, expected one"),
            ("created_after=yesterday", "created_after: got yesterday, expected a time such as 2026-01-31T12:00:00Z"),
            ("parent=nope", "parent: got nope, expected the id of a job"),
            ("needed=yes", "needed: got yes, expected true or false"),
            ("state=failed", "needed: missing, expected a value"),
            (
                "stat=failed",
                "stat: unknown parameter, expected one of state, created_after, parent, page_size, needed; did you mean state?",
            ),
        ] {
            let request = Request::get(format!("/?{query}")).body(axum::body::Body::empty()).unwrap();
            let refused = Query::<Parameters>::from_request_parts(&mut request.into_parts().0, &()).await.unwrap_err();
            assert_eq!(refused.to_string(), message, "{query}");
        }
    }

    #[tokio::test]
    async fn large_bodies_are_parsed_on_another_thread_than_the_connection_s() {
        for (bytes, large) in [(LARGE_BODY, false), (LARGE_BODY + 1, true)] {
            let body = format!("{{{}}}", " ".repeat(bytes - 2));
            let request = Request::post("/").header(header::CONTENT_TYPE, "application/json").body(body.into()).unwrap();
            let Json(ParsedOn(thread)) = Json::from_request(request, &()).await.unwrap();
            assert_eq!(thread != thread::current().id(), large, "{bytes}");
        }
    }
}
