//! The access table covers every method and route, and both transports enforce it.

use std::collections::BTreeSet;

use bytes::Bytes;
use prost::Message;
use prost_types::FileDescriptorSet;
use qedgix::api::access::{self, Requirement};
use qedgix::service::keys::Scope;
use reqwest::Method;
use serde_json::Value;
use tonic::Code;
use tonic::transport::Channel;
use tonic_types::StatusExt;

use super::super::harness::*;
use super::super::limits::Raw;
use super::{key, make, signed};

/// `SERVICE/METHOD` of all methods in the descriptor sets of reflection.
fn grpc_methods() -> Vec<String> {
    let sets = [qedgix::wire::DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET];
    let reflection = [tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET, tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET];
    let files = sets.into_iter().chain(reflection).flat_map(|set| FileDescriptorSet::decode(set).unwrap().file);
    let mut methods = Vec::new();
    for file in files {
        for service in &file.service {
            let name = |method: &str| format!("{}.{}/{method}", file.package(), service.name());
            methods.extend(service.method.iter().map(|method| name(method.name())));
        }
    }
    assert!(methods.len() > 25 && methods.contains(&"qedgix.v1.PolicyService/Act".to_owned()), "{methods:?}");
    methods
}

/// Verb and route of all routes: those of the OpenAPI document, and those below `/v2`, which are not in it.
async fn rest_routes(server: &Server) -> Vec<(Method, String)> {
    const VERBS: [&str; 5] = ["GET", "POST", "PUT", "PATCH", "DELETE"];
    let document: Value = reqwest::get(server.url("/openapi.json")).await.unwrap().json().await.unwrap();
    let mut routes = BTreeSet::new();
    for (route, item) in document["paths"].as_object().unwrap() {
        routes.extend(VERBS.into_iter().filter(|verb| item.get(verb.to_lowercase()).is_some()).map(|verb| (verb, route.clone())));
    }
    let source = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/src/api/rest/v2/mod.rs")).unwrap();
    for call in source.split(".route(").skip(1) {
        let (_, rest) = call.split_once('"').unwrap();
        let (route, rest) = rest.split_once('"').unwrap();
        let mut depth = 1;
        let end = rest.find(|c| {
            depth += i32::from(c == '(') - i32::from(c == ')');
            depth == 0
        });
        let handlers = &rest[..end.unwrap()];
        let before = routes.len();
        for verb in VERBS {
            let name = format!("{}(", verb.to_lowercase());
            if handlers.match_indices(&name).any(|(at, _)| handlers[..at].ends_with([' ', '.', ':'])) {
                routes.insert((verb, route.to_owned()));
            }
        }
        assert!(routes.len() > before, "no verb that this test knows in .route({route:?}, {handlers}");
    }
    for known in [("POST", "/v1/act"), ("DELETE", "/v1/policies/{name}/aliases/{alias}"), ("POST", "/v2/models/{model}/infer")] {
        assert!(routes.contains(&(known.0, known.1.to_owned())), "{routes:?}");
    }
    routes.into_iter().map(|(verb, route)| (verb.parse().unwrap(), route)).collect()
}

#[tokio::test]
async fn every_route_and_method_is_in_the_access_table() {
    let server = Server::start().await;
    let grpc = grpc_methods().into_iter().filter(|method| access::grpc_rule(&format!("/{method}")).is_none());
    let rest = rest_routes(&server).await.into_iter().filter(|(verb, route)| access::rest_rule(verb, route).is_none());
    let missing: Vec<String> = grpc.chain(rest.map(|(verb, route)| format!("{verb} {route}"))).collect();
    assert!(missing.is_empty(), "add them to src/api/access.rs: {missing:#?}");
}

/// The scope that meets the requirement, and all that do not.
fn scopes(requirement: Requirement) -> Option<(Scope, Vec<Scope>)> {
    let Requirement::Scope(scope) = requirement else { return None };
    let others = Scope::ALL.into_iter().filter(|other| *other != scope && *other != Scope::Admin);
    Some((scope, others.collect()))
}

/// A server whose jobs never run.
async fn without_workers() -> Server {
    Server::with(|config| config.worker = Some("/bin/false".into())).await
}

/// Status of a call and the scope that its key lacks.
async fn grpc(channel: &Channel, method: &str, key: Option<&str>) -> (Code, Option<String>) {
    let mut client = tonic::client::Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let request = key.map_or_else(|| tonic::Request::new(Bytes::new()), |key| signed(key, Bytes::new()));
    // Every kind of method responds to a stream of one message.
    let answer = with_timeout(client.server_streaming(request, format!("/{method}").parse().unwrap(), Raw)).await;
    let Err(status) = answer else { return (Code::Ok, None) };
    let info = status.get_details_error_info();
    (status.code(), info.and_then(|info| info.metadata.get("required_scope").cloned()))
}

#[tokio::test]
async fn grpc_enforces_the_access_table() {
    let server = without_workers().await;
    let channel = server.channel().await;
    assert_ne!(
        grpc(&channel, "qedgix.v1.PolicyService/ListPolicies", None).await.0,
        Code::Unauthenticated,
        "no key is required while none exists"
    );
    let of = [key(&server, "read").await, key(&server, "act").await, key(&server, "jobs").await, key(&server, "admin").await];
    for method in grpc_methods() {
        let worker = method.starts_with("qedgix.v1.WorkerService/");
        let (code, _) = grpc(&channel, &method, None).await;
        let requirement = access::grpc_requirement(&format!("/{method}"));
        let Some((scope, others)) = scopes(requirement) else {
            assert_eq!(requirement, Requirement::NoKey, "{method}");
            // Workers authenticate with the token of their attempt.
            assert_eq!(code == Code::Unauthenticated, worker, "{method}");
            continue;
        };
        assert_eq!(code, Code::Unauthenticated, "{method}");
        for right in [scope, Scope::Admin] {
            let (code, _) = grpc(&channel, &method, Some(&of[right as usize])).await;
            assert!(!matches!(code, Code::Unauthenticated | Code::PermissionDenied), "{method} with {right:?}");
        }
        for wrong in others {
            let refused = grpc(&channel, &method, Some(&of[wrong as usize])).await;
            assert_eq!(refused, (Code::PermissionDenied, Some(scope.name().to_owned())), "{method} with {wrong:?}");
        }
    }
    for nowhere in ["qedgix.v1.PolicyService/Forget", "no.such.Service/Method"] {
        assert_eq!(grpc(&channel, nowhere, None).await.0, Code::Unauthenticated);
        assert_eq!(grpc(&channel, nowhere, Some(&of[0])).await.0, Code::PermissionDenied);
        assert_eq!(grpc(&channel, nowhere, Some(&of[3])).await.0, Code::Unimplemented);
    }
    // Unknown methods do not become labels.
    let metrics = reqwest::Client::new().get(server.url("/metrics")).bearer_auth(&of[0]).send().await.unwrap();
    let metrics = metrics.text().await.unwrap();
    let refused = "grpc_service=\"qedgix.v1.PolicyService\",grpc_method=\"Act\",grpc_code=\"Unauthenticated\"";
    assert!(metrics.contains(refused), "{metrics}");
    assert!(!metrics.contains("Forget") && !metrics.contains("no.such.Service"), "{metrics}");
}

async fn rest(server: &Server, verb: &Method, path: &str, key: Option<&str>) -> (u16, Option<String>, String) {
    let request = reqwest::Client::new().request(verb.clone(), server.url(path));
    let request = if let Some(key) = key { request.header("x-api-key", key) } else { request };
    let answer = with_timeout(request.send()).await.unwrap();
    let asked = answer.headers().get("www-authenticate").map(|value| value.to_str().unwrap().to_owned());
    (answer.status().as_u16(), asked, answer.text().await.unwrap())
}

#[tokio::test]
async fn rest_enforces_the_access_table() {
    let server = without_workers().await;
    assert_eq!(rest(&server, &Method::GET, "/v1/policies", None).await.0, 200, "no key is required while none exists");
    let of = [key(&server, "read").await, key(&server, "act").await, key(&server, "jobs").await, key(&server, "admin").await];
    let mut open = BTreeSet::new();
    for (verb, route) in rest_routes(&server).await {
        let path = route.split('/').map(|part| if part.starts_with('{') { "x" } else { part }).collect::<Vec<_>>().join("/");
        let (status, asked, text) = rest(&server, &verb, &path, None).await;
        let Some((scope, others)) = scopes(access::rest_requirement(&verb, Some(&route))) else {
            assert!(!matches!(status, 401 | 403), "{verb} {route}: {text}");
            open.insert(route);
            continue;
        };
        assert_eq!((status, asked.as_deref()), (401, Some("Bearer realm=\"qedgix\"")), "{verb} {route}");
        assert!(text.contains("\"code\":\"unauthenticated\""), "{text}");
        for right in [scope, Scope::Admin] {
            let (status, _, text) = rest(&server, &verb, &path, Some(&of[right as usize])).await;
            assert!(!matches!(status, 401 | 403), "{verb} {route} with {right:?}: {text}");
        }
        for wrong in others {
            let (status, _, text) = rest(&server, &verb, &path, Some(&of[wrong as usize])).await;
            assert_eq!(status, 403, "{verb} {route} with {wrong:?}: {text}");
            let problem: Value = serde_json::from_str(&text).unwrap();
            assert_eq!(problem["code"], "permission_denied", "{text}");
            assert_eq!(problem["required_scope"], scope.name(), "{text}");
        }
    }
    assert!(open.contains("/livez") && open.contains("/readyz"), "{open:?}");
    // An unknown path is 404 for any valid key; an unknown verb is 405 for admins. Both are 401 without a key.
    for (verb, path, statuses) in [("GET", "/v1/nothing", [401, 404, 404]), ("PURGE", "/v1/act", [401, 403, 405])] {
        let verb: Method = verb.parse().unwrap();
        for (key, status) in [None, Some(&of[0]), Some(&of[3])].into_iter().zip(statuses) {
            assert_eq!(rest(&server, &verb, path, key.map(String::as_str)).await.0, status, "{verb} {path}");
        }
    }
    let metrics = rest(&server, &Method::GET, "/metrics", Some(&of[0])).await.2;
    assert!(metrics.contains("status=\"401\"") && !metrics.contains("PURGE"), "{metrics}");
    assert_eq!(rest(&server, &Method::HEAD, "/v1/policies", Some(&of[0])).await.0, 200);
    assert_eq!(rest(&server, &Method::HEAD, "/v1/policies", Some(&of[1])).await.0, 403);
}

#[tokio::test]
async fn keys_can_have_several_scopes_and_are_read_from_both_headers() {
    let server = Server::start().await;
    let created = make(&server, "read,jobs", |_| {}).await;
    let client = reqwest::Client::new();
    let get = client.get(server.url("/v1/jobs"));
    assert_eq!(get.try_clone().unwrap().bearer_auth(&created.key).send().await.unwrap().status(), 200);
    assert_eq!(get.try_clone().unwrap().header("x-api-key", &created.key).send().await.unwrap().status(), 200);
    assert_eq!(get.basic_auth("me", Some(&created.key)).send().await.unwrap().status(), 401);
    let post = |path| client.post(server.url(path)).bearer_auth(&created.key).body("{}").send();
    assert_ne!(post("/v1/jobs").await.unwrap().status(), 403);
    assert_eq!(post("/v1/act").await.unwrap().status(), 403);
    let channel = server.channel().await;
    let mut request = tonic::Request::new(Bytes::new());
    request.metadata_mut().insert("x-api-key", created.key.parse().unwrap());
    let mut grpc = tonic::client::Grpc::new(channel);
    grpc.ready().await.unwrap();
    let path = "/qedgix.v1.PolicyService/ListPolicies".parse().unwrap();
    assert!(grpc.server_streaming(request, path, Raw).await.is_ok());
}
