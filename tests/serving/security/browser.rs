//! What a page in a browser can do to a server without keys: nothing.

use qedgix::wire::v1;
use reqwest::{Client, Method, RequestBuilder};
use serde_json::{Value, json};
use tonic::{Code, Request};

use super::super::harness::*;
use super::key;

async fn answer(request: RequestBuilder) -> (u16, Value, reqwest::header::HeaderMap) {
    let answer = with_timeout(request.send()).await.unwrap();
    let (status, headers) = (answer.status().as_u16(), answer.headers().clone());
    (status, serde_json::from_str(&answer.text().await.unwrap()).unwrap_or(Value::Null), headers)
}

/// Requests that change something, without a body and with the bodies that a page can send without asking first.
const CHANGES: &[(&str, &str, Option<&str>, &str)] = &[
    ("POST", "/v1/sessions", None, "{\"policy\": \"sweep\"}"),
    ("POST", "/v1/sessions", Some("text/plain"), "{\"policy\": \"sweep\"}"),
    ("POST", "/v1/sessions", Some("application/json"), "{\"policy\": \"sweep\"}"),
    ("POST", "/v1/jobs", Some("application/x-www-form-urlencoded"), "{}"),
    ("POST", "/v1/policies/sweep/unload", None, ""),
    ("POST", "/v1/policies/sweep/unload", Some("multipart/form-data; boundary=x"), "--x--"),
    ("POST", "/v2/repository/models/nearest/unload", None, ""),
    ("POST", "/v2/repository/models/nearest/unload", Some("text/plain"), "{}"),
    ("POST", "/v2/models/sweep/infer", None, "{}"),
    ("PUT", "/v1/policies/qedgix/aliases/live", Some("application/json"), "{\"version\": 1}"),
    ("DELETE", "/v1/sessions/s", None, ""),
    ("OPTIONS", "/v1/jobs", None, ""),
];

/// Reading, where a rebound name could pass the response on.
const READS: &[(&str, &str)] = &[
    ("GET", "/"),
    ("GET", "/v1/policies"),
    ("HEAD", "/v1/policies"),
    ("GET", "/v1/policies/qedgix/export"),
    ("GET", "/v2/models/sweep"),
    ("GET", "/metrics"),
    ("GET", "/docs"),
    ("GET", "/openapi.json"),
    ("GET", "/v1/nothing"),
];

fn change(server: &Server, (verb, path, kind, body): (&str, &str, Option<&str>, &'static str)) -> RequestBuilder {
    let request = Client::new().request(verb.parse().unwrap(), server.url(path)).body(body);
    match kind {
        Some(kind) => request.header("content-type", kind),
        None => request,
    }
}

#[tokio::test]
async fn pages_of_other_sites_command_and_read_nothing() {
    let server = Server::start().await;
    let host = server.endpoints.http;
    let foreign: [&[(&str, String)]; 6] = [
        &[("origin", "https://other.example".into()), ("sec-fetch-site", "cross-site".into())],
        &[("origin", "null".into())],
        &[("origin", format!("http://localhost:{}", host.port() ^ 1))],
        &[("sec-fetch-site", "same-site".into())],
        // A rebound name: the page is of the same origin as its requests.
        &[("host", "other.example".into()), ("origin", "http://other.example".into()), ("sec-fetch-site", "same-origin".into())],
        &[("host", format!("other.example:{}", host.port()))],
    ];
    for headers in foreign {
        let with = |request: RequestBuilder| headers.iter().fold(request, |request, (name, value)| request.header(*name, value));
        for case in CHANGES {
            let (status, problem, _) = answer(with(change(&server, *case))).await;
            assert_eq!((status, &problem["code"]), (403, &json!("cross_site")), "{case:?} {headers:?}");
        }
        for (verb, path) in READS {
            let request = Client::new().request(verb.parse().unwrap(), server.url(path));
            assert_eq!(answer(with(request)).await.0, 403, "{verb} {path} {headers:?}");
        }
        let probe = with(Client::new().get(server.url("/readyz")));
        assert_eq!(answer(probe).await.0, if headers[0].0 == "host" { 200 } else { 403 }, "{headers:?}");
    }
    let mut client = server.grpc().await;
    for (name, value) in [("origin", "http://other.example"), ("sec-fetch-site", "cross-site")] {
        let mut request = Request::new(v1::ListPoliciesRequest::default());
        request.metadata_mut().insert(name, value.parse().unwrap());
        let (code, reason, field) = refused(client.list_policies(request).await);
        assert_eq!((code, reason.as_str(), field.as_str()), (Code::PermissionDenied, "cross_site", name));
    }
    // Nothing has happened.
    assert!(server.app.sessions.is_empty());
    let (_, policy, _) = answer(Client::new().get(server.url("/v1/policies/sweep"))).await;
    assert_eq!(policy["loaded"], true);
}

#[tokio::test]
async fn its_own_pages_and_names_are_accepted() {
    let server = Server::with(|config| config.allow_hosts = vec!["UAVs.example".into()]).await;
    let port = server.endpoints.http.port();
    for host in ["localhost", "LOCALHOST.", "127.0.0.1", "[::1]", "uavs.example"] {
        for host in [host.to_owned(), format!("{host}:{port}")] {
            let open = change(&server, ("POST", "/v1/sessions", Some("application/json"), "{\"policy\": \"sweep\"}"));
            let own =
                open.header("host", &host).header("origin", format!("http://{host}")).header("sec-fetch-site", "same-origin");
            assert_eq!(answer(own).await.0, 201, "{host}");
            let typed = Client::new().get(server.url("/docs")).header("host", &host).header("sec-fetch-site", "none");
            assert_eq!(answer(typed).await.0, 200, "{host}");
        }
    }
    // With keys, a page has no key, so names do not matter.
    let key = key(&server, "read").await;
    let rebound = Client::new().get(server.url("/v1/policies")).header("host", "other.example");
    assert_eq!(answer(rebound.try_clone().unwrap()).await.0, 401);
    assert_eq!(answer(rebound.bearer_auth(key)).await.0, 200);
}

#[tokio::test]
async fn bodies_need_a_content_type_that_pages_cannot_send() {
    let server = Server::start().await;
    for (verb, path, kind, body) in CHANGES {
        let allowed = body.is_empty() || kind == &Some("application/json") || (path.starts_with("/v2") && kind.is_none());
        let (status, problem, _) = answer(change(&server, (verb, path, *kind, body))).await;
        assert_eq!(status == 415, !allowed, "{verb} {path} {kind:?}: {problem}");
    }
    // The clients of the Open Inference Protocol send no content type, and no headers of a browser.
    let infer = || change(&server, ("POST", "/v2/models/sweep/infer", None, "{}"));
    assert_eq!(answer(infer()).await.1["code"], "invalid_schema");
    let of_a_page = infer().header("sec-fetch-site", "same-origin");
    assert_eq!(answer(of_a_page).await.1["code"], "unsupported_media_type");
}

#[tokio::test]
async fn responses_tell_browsers_not_to_guess_types_and_not_to_embed_them() {
    let server = Server::start().await;
    for (path, viewer) in [
        ("/", true),
        ("/ui/app.css", true),
        ("/v1/policies", false),
        ("/v1/nothing", false),
        ("/v2/nothing", false),
        ("/metrics", false),
        ("/docs", true),
        ("/docs/swagger-ui.css", true),
    ] {
        let (_, _, headers) = answer(Client::new().request(Method::GET, server.url(path))).await;
        assert_eq!(headers["x-content-type-options"], "nosniff", "{path}");
        assert_eq!(headers["x-frame-options"], "DENY", "{path}");
        let policy = headers["content-security-policy"].to_str().unwrap();
        assert!(policy.starts_with("default-src 'none'; ") && policy.contains("frame-ancestors 'none'"), "{path}: {policy}");
        assert_eq!(policy.contains("script-src 'self'"), viewer, "{path}: {policy}");
    }
}

#[tokio::test]
async fn duplicate_keys_are_refused_in_every_document() {
    let server = Server::start().await;
    for (path, body) in [
        ("/v1/sessions", r#"{"policy": "sweep", "policy": "sweep"}"#),
        ("/v1/jobs", r#"{"labels": {"a": "1", "a": "2"}}"#),
        ("/v1/jobs", r#"{"training": {"steps": 400, "steps": 500}}"#),
        ("/v1/jobs", r#"{"environment": {"layout": {"given": [], "given": []}}}"#),
        ("/v1/environments", r#"{"environment": {"uavs": 2, "uavs": 3}}"#),
        ("/v2/models/sweep/infer", r#"{"inputs": [], "parameters": {"priority": 1, "priority": 2}}"#),
        ("/v2/models/sweep/infer", r#"{"inputs": [{"name": "x", "name": "x", "shape": [], "datatype": "FP32"}]}"#),
        ("/v2/repository/models/sweep/unload", r#"{"parameters": {"unload_dependents": true, "unload_dependents": true}}"#),
    ] {
        let request = Client::new().post(server.url(path)).header("content-type", "application/json").body(body);
        let (status, problem, _) = answer(request).await;
        assert_eq!((status, &problem["code"]), (422, &json!("invalid_schema")), "{body}: {problem}");
        assert_eq!(problem["expected"], "each field once", "{body}: {problem}");
    }
}

#[tokio::test]
async fn the_data_directory_is_private() {
    use std::os::unix::fs::PermissionsExt;
    let parent = tempfile::tempdir().unwrap();
    let mode = |path: &std::path::Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    std::fs::set_permissions(parent.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    std::fs::write(parent.path().join("lock"), "").unwrap();
    std::fs::set_permissions(parent.path().join("lock"), std::fs::Permissions::from_mode(0o644)).unwrap();
    let server = Server::on(parent, |_| {}).await;
    let dir = server.dir.path();
    with_timeout(async {
        while !dir.join("endpoints.json").exists() {
            tokio::task::yield_now().await;
        }
    })
    .await;
    assert_eq!(mode(dir), 0o700);
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        assert_eq!(mode(&path), 0o600, "{}", path.display());
    }
}
