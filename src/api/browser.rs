//! Protection from pages in a browser. A page of any site can make the browser of its visitor send requests to a server on
//! loopback, and a name that its owner points to loopback (DNS rebinding) makes such a page read the responses, too. API keys
//! prevent both, because a page does not have them. On a server without keys, a request must name a host that the server
//! goes by, and must not come from a page of another origin.

use std::net::IpAddr;

use axum::http::{HeaderMap, HeaderValue, Method, Request, Version, header, uri};
use http_body::Body;

use super::is_probe;
use super::media_type::{media_type, unsupported};
use crate::invalid::Invalid;
use crate::service::Error;

/// The hosts that requests may name on a server without keys: `localhost`, loopback addresses, the address that the server
/// listens on (any IP address if it listens on all), and further names.
#[derive(Clone, Debug)]
pub struct AllowedHosts {
    bound: IpAddr,
    names: Vec<String>,
}

impl AllowedHosts {
    /// The hosts of a server that listens on `bound`, and the further `names`.
    pub fn new(bound: IpAddr, names: &[String]) -> Self {
        Self { bound, names: names.iter().map(|name| normal(name)).collect() }
    }

    fn allow(&self, host: &str) -> bool {
        let address = |ip: IpAddr| {
            let ip = ip.to_canonical();
            ip.is_loopback() || ip == self.bound || self.bound.is_unspecified()
        };
        host == "localhost" || self.names.iter().any(|name| name == host) || host.parse().is_ok_and(address)
    }

    /// Checks that a request to a server without keys is not one that a page of another site makes a browser send, and names an
    /// allowed host. Probes may name any host.
    ///
    /// # Errors
    /// [`Error::CrossSite`] with the header.
    pub(super) fn check<B>(&self, request: &Request<B>) -> Result<(), Error> {
        let named = named_host(request)?;
        if let Some(named) = named.as_ref().filter(|named| !self.allow(&named.host) && !is_probe(request.uri().path())) {
            let expected = "localhost, a loopback address, the address that the server listens on, or a name of --allow-host";
            return Err(Error::CrossSite(Invalid::new("host", format!("{:?}", named.host), expected)));
        }
        if opens_a_page(request) {
            return Ok(());
        }
        check_origin(request.headers(), |origin| {
            self.names.contains(&origin.host) || named.as_ref().is_some_and(|named| origin.same_as(named))
        })
    }
}

/// Whether a browser opens the dashboard or the viewer of the OpenAPI document, for instance by a link in a message. Such pages may be
/// opened from anywhere: they have no data of their own, and the page with the link can neither read nor embed them.
fn opens_a_page<B>(request: &Request<B>) -> bool {
    let is = |name: &str, value: &str| request.headers().get(name).is_some_and(|found| found == value);
    *request.method() == Method::GET
        && matches!(request.uri().path(), "/" | "/docs")
        && is("sec-fetch-mode", "navigate")
        && is("sec-fetch-dest", "document")
}

/// Checks a gRPC call to a server without keys. Browsers cannot speak gRPC, so only their headers are checked, not the host.
///
/// # Errors
/// [`Error::CrossSite`] with the header.
pub(super) fn check_grpc(headers: &HeaderMap) -> Result<(), Error> {
    check_origin(headers, |_| false)
}

/// Checks that the page that sends the request, if any, is of an allowed origin.
fn check_origin(headers: &HeaderMap, allowed: impl Fn(&Authority) -> bool) -> Result<(), Error> {
    let refused = |field: &str, value: &HeaderValue, expected: &str| {
        Err(Error::CrossSite(Invalid::new(field, format!("{value:?}"), expected)))
    };
    if let Some(site) = headers.get("sec-fetch-site").filter(|site| *site != "same-origin" && *site != "none") {
        return refused(
            "sec-fetch-site",
            site,
            "same-origin or none: pages of other sites may not use a server without API keys",
        );
    }
    for origin in headers.get_all(header::ORIGIN) {
        if !origin.to_str().ok().and_then(Authority::of_origin).is_some_and(|origin| allowed(&origin)) {
            return refused(
                "origin",
                origin,
                "the origin of this server: pages of other sites may not use a server without API keys",
            );
        }
    }
    Ok(())
}

/// The host and port of a request, in lower case.
struct Authority {
    host: String,
    port: Option<u16>,
}

impl Authority {
    fn parse(text: &str) -> Option<Self> {
        let authority: uri::Authority = text.parse().ok().filter(|_| !text.contains('@'))?;
        Some(Self { host: normal(authority.host()), port: authority.port_u16() })
    }

    /// `scheme://host[:port]`, with the port that the scheme implies.
    fn of_origin(text: &str) -> Option<Self> {
        let (scheme, authority) = text.split_once("://")?;
        let implied = if scheme == "https" { 443 } else { 80 };
        Self::parse(authority).map(|authority| Self { port: authority.port.or(Some(implied)), ..authority })
    }

    /// Whether this origin is that of the server at `named`, which has no port if the scheme implies it.
    fn same_as(&self, named: &Self) -> bool {
        let implied = named.port.is_none() && matches!(self.port, Some(80 | 443));
        self.host == named.host && (self.port == named.port || implied)
    }
}

/// A host in lower case, without the brackets of an IPv6 address and without the dot at the end of a full name.
fn normal(host: &str) -> String {
    let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    host.strip_suffix('.').unwrap_or(host).to_ascii_lowercase()
}

/// The host that a request names in its target or its header. Before HTTP/1.1 it may name none.
fn named_host<B>(request: &Request<B>) -> Result<Option<Authority>, Error> {
    let mut texts: Vec<&str> = request.uri().authority().map(uri::Authority::as_str).into_iter().collect();
    let wrong = |value: String| Error::CrossSite(Invalid::new("host", value, "one host, as HOST or HOST:PORT"));
    for host in request.headers().get_all(header::HOST) {
        texts.push(host.to_str().map_err(|_| wrong(format!("{host:?}")))?);
    }
    let Some(first) = texts.first() else {
        let may_lack = request.version() < Version::HTTP_11;
        return if may_lack { Ok(None) } else { Err(wrong("none".into())) };
    };
    if texts.iter().any(|text| text != first) {
        return Err(wrong(format!("{texts:?}")));
    }
    Authority::parse(first).map(Some).ok_or_else(|| wrong(format!("{first:?}")))
}

/// Checks that a body has a content type that a page of another site cannot send without asking the server first: JSON, or bytes.
/// The clients of the Open Inference Protocol send none; they may, because they send no headers of a browser either.
///
/// # Errors
/// [`Error::MediaType`].
pub(super) fn check_media_type<B: Body>(request: &Request<B>) -> Result<(), Error> {
    let headers = request.headers();
    if matches!(*request.method(), Method::GET | Method::HEAD) || !has_body(request) {
        return Ok(());
    }
    match media_type(headers) {
        Some(kind) if kind == "application/json" || kind == "application/octet-stream" => Ok(()),
        None if request.uri().path().starts_with("/v2/") && !is_of_browser(headers) => Ok(()),
        kind => Err(unsupported(kind, "application/json or application/octet-stream")),
    }
}

fn is_of_browser(headers: &HeaderMap) -> bool {
    headers.contains_key(header::ORIGIN) || headers.contains_key("sec-fetch-site")
}

fn has_body<B: Body>(request: &Request<B>) -> bool {
    match request.headers().get(header::CONTENT_LENGTH) {
        Some(length) => length != "0",
        None if request.version() < Version::HTTP_2 => request.headers().contains_key(header::TRANSFER_ENCODING),
        None => !request.body().is_end_stream(),
    }
}

/// What a page of responses may load: nothing.
const NOTHING: &str = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
/// What the viewer of the OpenAPI document loads: its own files and the document. It sets styles of its elements.
const VIEWER: &str = "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; \
                      connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// What the dashboard loads: its own files and responses of this server. It saves files through addresses of the page itself.
const DASHBOARD: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                         frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// Adds the headers that keep browsers from guessing content types and other sites from embedding responses. `route`: the route
/// of the request.
pub(super) fn add_headers(route: &str, headers: &mut HeaderMap) {
    let policy = match route {
        "/docs" | "/docs/{file}" => VIEWER,
        "/" | "/ui/{file}" => DASHBOARD,
        _ => NOTHING,
    };
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(policy));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::X_FRAME_OPTIONS, HeaderValue::from_static("DENY"));
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The field that is refused.
    fn refused(hosts: &AllowedHosts, headers: &[(&str, &str)]) -> Option<String> {
        let mut request = Request::get("/v1/policies");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let error = hosts.check(&request.body(()).unwrap()).err()?;
        Some(error.invalid().unwrap().field.clone())
    }

    fn hosts(bound: &str) -> AllowedHosts {
        AllowedHosts::new(bound.parse().unwrap(), &["UAVs.example".to_owned()])
    }

    #[test]
    fn only_hosts_of_the_server_are_allowed() {
        let all = [
            ("127.0.0.1", true),
            ("127.0.0.1:8080", true),
            ("LocalHost:8080", true),
            ("localhost.", true),
            ("[::1]:8080", true),
            ("[::ffff:127.0.0.1]", true),
            ("uavs.example:9", true),
            ("10.1.2.3", false),
            ("other.example", false),
            ("localhost.other.example", false),
            ("127.0.0.1.other.example:80", false),
            ("user@localhost", false),
            ("2130706433", false),
            ("", false),
        ];
        for (host, allowed) in all {
            assert_eq!(refused(&hosts("127.0.0.1"), &[("host", host)]).is_none(), allowed, "{host}");
        }
        assert!(refused(&hosts("0.0.0.0"), &[("host", "10.1.2.3:80")]).is_none(), "no name was looked up");
        assert!(refused(&hosts("10.1.2.3"), &[("host", "10.1.2.3")]).is_none());
        assert!(refused(&hosts("0.0.0.0"), &[("host", "other.example")]).is_some());
        assert!(refused(&hosts("127.0.0.1"), &[]).is_some(), "HTTP/1.1 requires a host");
        assert!(refused(&hosts("127.0.0.1"), &[("host", "localhost"), ("host", "other.example")]).is_some());
    }

    #[test]
    fn links_on_other_pages_open_the_dashboard_and_nothing_else() {
        let of = |path: &str, mode: &str, dest: &str| {
            let request = Request::get(path).header("host", "localhost").header("sec-fetch-site", "cross-site");
            let request = request.header("sec-fetch-mode", mode).header("sec-fetch-dest", dest);
            hosts("127.0.0.1").check(&request.body(()).unwrap()).is_ok()
        };
        assert!(of("/", "navigate", "document") && of("/docs", "navigate", "document"));
        assert!(!of("/", "navigate", "iframe") && !of("/", "no-cors", "script") && !of("/v1/jobs", "navigate", "document"));
    }

    #[test]
    fn only_pages_of_the_server_are_allowed() {
        let host = ("host", "localhost:8080");
        for (origin, allowed) in [
            ("http://localhost:8080", true),
            ("http://LOCALHOST:8080", true),
            ("http://uavs.example", true),
            ("http://localhost:3000", false),
            ("http://localhost", false),
            ("http://other.example", false),
            ("http://other.example:8080", false),
            ("null", false),
            ("", false),
        ] {
            let field = refused(&hosts("127.0.0.1"), &[host, ("origin", origin)]);
            assert_eq!(field.as_deref(), (!allowed).then_some("origin"), "{origin}");
        }
        for (site, allowed) in [("same-origin", true), ("none", true), ("same-site", false), ("cross-site", false), ("", false)] {
            let field = refused(&hosts("127.0.0.1"), &[host, ("sec-fetch-site", site)]);
            assert_eq!(field.as_deref(), (!allowed).then_some("sec-fetch-site"), "{site}");
        }
        assert_eq!(refused(&hosts("127.0.0.1"), &[("host", "localhost"), ("origin", "http://localhost")]), None);
    }
}
