//! The OpenAPI document: nothing served is missing, nothing described is not there, its examples work when pasted, its bounds
//! are those that are checked; and the page that shows it needs no network.

use std::collections::{BTreeMap, BTreeSet};

use qedgix::jobs::spec::JobRequest;
use reqwest::{Client, Method, StatusCode};
use serde_json::{Value, json};

use super::harness::*;
use super::rest::Rest;

async fn document(server: &Server) -> Value {
    let (status, document) = Rest::new(server).get("/openapi.json").await;
    assert_eq!((status, &document["openapi"]), (StatusCode::OK, &json!("3.1.0")));
    document
}

/// Paths with their operations by verb.
fn paths(document: &Value) -> impl Iterator<Item = (&String, &serde_json::Map<String, Value>)> {
    document["paths"].as_object().unwrap().iter().map(|(path, item)| (path, item.as_object().unwrap()))
}

/// What `value` refers to, or itself.
fn followed<'a>(document: &'a Value, value: &'a Value) -> &'a Value {
    match value["$ref"].as_str() {
        Some(reference) => document.pointer(reference.strip_prefix('#').unwrap()).unwrap(),
        None => value,
    }
}

/// Verbs by path, in small letters, as axum's router writes itself down. There is no other way to ask it.
fn routes(router: &axum::Router) -> BTreeMap<String, BTreeSet<String>> {
    let text = format!("{router:?}");
    // What comes behind is the answer to everything else.
    let text = text.split("fallback_router").next().unwrap();
    let numbered = |open: &'static str, close: &'static str| {
        text.split("RouteId(").filter_map(move |part| {
            let (id, rest) = part.split_once("): ")?;
            let inside = rest.split(&format!("RouteId({id})")).next()?.split_once(open)?.1.split_once(close)?.0;
            Some((id.parse::<u32>().ok()?, inside.to_owned()))
        })
    };
    let allowed: BTreeMap<u32, String> = numbered("allow_header: Bytes(b\"", "\")").collect();
    let paths = numbered("\"/", "\"").map(|(id, path)| (id, format!("/{path}")));
    let verbs = |id| allowed[&id].split(',').filter(|&verb| verb != "HEAD").map(str::to_lowercase).collect();
    // The Open Inference Protocol has a document of its own.
    let ours = paths.filter(|(_, path)| !path.starts_with("/v2"));
    ours.filter(|(id, _)| allowed.contains_key(id)).map(|(id, path)| (path, verbs(id))).collect()
}

#[tokio::test]
async fn every_route_is_described_and_no_other() {
    let server = Server::start().await;
    let background = tokio::runtime::Handle::current();
    let served = routes(&qedgix::api::rest::router(server.app.clone(), String::new, 1 << 20, localhost(), background));
    assert!(served.len() > 30 && served["/v1/sessions"].len() == 2, "the router writes itself down otherwise: {served:?}");
    let document = document(&server).await;
    let described = paths(&document).map(|(path, item)| (path.clone(), item.keys().cloned().collect()));
    assert_eq!(served, described.collect());

    let index = Rest::new(&server).get("/").await.1;
    let listed: BTreeSet<&str> = index["endpoints"].as_array().unwrap().iter().map(|e| e.as_str().unwrap()).collect();
    assert_eq!(listed.len(), served.values().map(BTreeSet::len).sum::<usize>());
    assert!(listed.contains("PUT /v1/policies/{name}/aliases/{alias}"));
}

#[tokio::test]
async fn operations_say_who_they_are_and_problems_are_problems() {
    let server = Server::start().await;
    let document = document(&server).await;
    let mut ids = BTreeSet::new();
    for (path, item) in paths(&document) {
        for (verb, operation) in item {
            let id = operation["operationId"].as_str().unwrap();
            assert!(ids.insert(id), "{id} twice");
            assert!(operation["summary"].is_string() && operation["tags"][0].is_string(), "{id}");
            let responses = operation["responses"].as_object().unwrap();
            assert!(responses.keys().any(|status| status.starts_with('2')), "{id}");
            for (status, response) in responses.iter().filter(|(status, _)| status.starts_with(['4', '5'])) {
                let problem = &followed(&document, response)["content"]["application/problem+json"]["schema"]["$ref"];
                assert_eq!(problem, "#/components/schemas/Problem", "{id} {status}");
            }
            assert_eq!(path.starts_with("/v1"), responses.contains_key("401"), "{id}");
            if operation["requestBody"].is_object() {
                for status in ["400", "413", "415", "422"] {
                    assert!(responses.contains_key(status), "{verb} {path} {status}");
                }
            }
            let named = operation["parameters"].as_array().into_iter().flatten().filter(|p| p["in"] == "path").count();
            assert_eq!(named, path.matches('{').count(), "{id}");
        }
    }
    let schemes = &document["components"]["securitySchemes"];
    assert_eq!((&schemes["bearer"]["scheme"], &schemes["api_key"]["name"]), (&json!("bearer"), &json!("x-api-key")));
    // Links lead somewhere.
    let text = document.to_string();
    for link in text.split("\"operationId\":\"").skip(1) {
        assert!(ids.contains(link.split('"').next().unwrap()));
    }
    for reference in text.split("\"$ref\":\"#").skip(1) {
        let reference = reference.split('"').next().unwrap();
        assert!(document.pointer(reference).is_some(), "{reference}");
    }
}

/// What responses call `policy` is a version reference, so every path parameter of that name accepts one.
#[tokio::test]
async fn version_references_are_accepted_wherever_a_path_has_a_policy() {
    let server = Server::start().await;
    let document = document(&server).await;
    let mut tried = 0;
    for (path, item) in paths(&document).filter(|(path, _)| path.contains("{policy}")) {
        // A policy is deleted by its name alone.
        for verb in item.keys().filter(|verb| *verb != "delete") {
            let verb = Method::from_bytes(verb.to_uppercase().as_bytes()).unwrap();
            let response = Client::new().request(verb, server.url(&path.replace("{policy}", "qedgix:1"))).send().await.unwrap();
            assert_eq!(response.status(), StatusCode::OK, "{path}");
            tried += 1;
        }
    }
    assert!(tried >= 4, "{tried}");
}

/// Sends what the document shows as an example of this operation.
async fn pasted(server: &Server, document: &Value, id: &str) -> (StatusCode, Value) {
    let operations = paths(document).flat_map(|(path, item)| item.iter().map(move |(verb, operation)| (path, verb, operation)));
    let (path, verb, operation) = operations.into_iter().find(|(_, _, operation)| operation["operationId"] == id).unwrap();
    let mut path = path.clone();
    for parameter in operation["parameters"].as_array().into_iter().flatten().filter(|p| p["in"] == "path") {
        let (name, example) = (parameter["name"].as_str().unwrap(), parameter["example"].as_str().unwrap());
        path = path.replace(&format!("{{{name}}}"), example);
    }
    let verb = Method::from_bytes(verb.to_uppercase().as_bytes()).unwrap();
    let mut request = Client::new().request(verb, server.url(&path));
    if operation["requestBody"].is_object() {
        let schema = &operation["requestBody"]["content"]["application/json"]["schema"];
        request = request.json(&followed(document, schema)["example"]);
    }
    let answer = request.send().await.unwrap();
    (answer.status(), answer.json().await.unwrap_or_default())
}

#[tokio::test]
async fn examples_work_when_they_are_pasted() {
    let server = Server::with(|config| config.worker = Some("false".into())).await;
    let document = document(&server).await;
    for id in [
        "index",
        "live",
        "ready",
        "metrics",
        "openapi",
        "docs",
        "docsFile",
        "act",
        "openSession",
        "getSession",
        "listSessions",
        "closeSession",
        "createEnvironment",
        "getEnvironment",
        "resetEnvironment",
        "stepEnvironment",
        "listEnvironments",
        "deleteEnvironment",
        "listPolicies",
        "getPolicy",
        "exportPolicy",
        "setAlias",
        "listAliases",
        "listAliasMoves",
        "deleteAlias",
        "unloadPolicy",
        "loadPolicy",
        "submitJob",
        "listJobs",
    ] {
        let (status, answer) = pasted(&server, &document, id).await;
        assert!(status.is_success(), "{id}: {status} {answer}");
    }
    // Ids of jobs are the server's: their examples are nobody's.
    for id in ["getJob", "listJobMetrics", "listCheckpoints", "listJobLogs", "cancelJob", "getCheckpoint"] {
        assert_eq!(pasted(&server, &document, id).await.0, StatusCode::NOT_FOUND, "{id}");
    }
}

/// Values at and beyond the bounds of a number's schema: what has to be allowed, and what has not.
fn bounds(schema: &Value) -> (Vec<Value>, Vec<Value>) {
    let ends = [(&schema["minimum"], -1.0), (&schema["maximum"], 1.0)].into_iter().filter(|(end, _)| end.is_number());
    let (mut at, mut beyond) = (Vec::new(), Vec::new());
    for (end, sign) in ends {
        at.push(end.clone());
        let value = end.as_f64().unwrap();
        if end.as_u64() == Some(u64::MAX) {
            beyond.push(json!(value));
            continue;
        }
        let whole = schema["type"].as_str() == Some("integer");
        beyond.push(if whole { json!(value as i64 + sign as i64) } else { json!(value + sign * (value.abs() / 2.0).max(1e-12)) });
    }
    (at, beyond)
}

#[tokio::test]
async fn the_bounds_of_a_job_are_those_that_are_checked() {
    let server = Server::with(|config| config.cpu_budget = 3).await;
    let document = document(&server).await;
    let job = &document["components"]["schemas"]["JobRequest"];
    let environment = &document["components"]["schemas"]["Environment"];
    let mut checked = 0;
    for (section, schema) in [("", job), ("environment", environment), ("training", &job["properties"]["training"]["oneOf"][0])] {
        for (field, schema) in schema["properties"].as_object().unwrap() {
            let (path, full) = if section.is_empty() {
                (json!({}), field.clone())
            } else {
                (json!({section: {}}), format!("{section}.{field}"))
            };
            let with = |value: &Value| {
                let mut job = path.clone();
                if section.is_empty() {
                    job[field] = value.clone();
                } else {
                    job[section][field] = value.clone();
                }
                JobRequest::from_json(job)?.resolve(3)
            };
            let (at, beyond) = bounds(schema);
            for value in &beyond {
                let refused = with(value).expect_err(&format!("{full} = {value}"));
                assert_eq!(refused.field, full, "{refused}");
                checked += 1;
            }
            for value in &at {
                // How fields fit together is another matter.
                let fits = with(value).map_or_else(|e| !e.expected.starts_with("a number from"), |_| true);
                assert!(fits, "{full} = {value}");
            }
        }
    }
    assert!(checked > 50, "{checked}");
}

#[tokio::test]
async fn the_bounds_of_queries_and_bodies_are_those_that_are_checked() {
    let server = Server::start().await;
    let (document, rest) = (document(&server).await, Rest::new(&server));
    let mut checked = 0;
    for (path, item) in paths(&document).filter(|(path, _)| !path.contains("{id}")) {
        let path = path.replace("{policy}", "qedgix").replace("{name}", "qedgix");
        for parameter in item.get("get").and_then(|get| get["parameters"].as_array()).into_iter().flatten() {
            let (at, beyond) = bounds(&parameter["schema"]);
            for (values, fits) in [(at, true), (beyond, false)] {
                for value in values {
                    let path = format!("{path}?{}={value}", parameter["name"].as_str().unwrap());
                    assert_eq!(rest.get(&path).await.0.is_success(), fits, "{path}");
                    checked += 1;
                }
            }
        }
    }
    assert!(checked >= 20, "{checked}");
    let schemas = &document["components"]["schemas"];
    let example = &schemas["ActRequest"]["example"];
    for (list, schema) in [("uavs", "Uav"), ("users", "User")] {
        for (field, schema) in schemas[schema]["properties"].as_object().unwrap() {
            let (at, beyond) = bounds(schema);
            for (values, fits) in [(at, true), (beyond, false)] {
                for value in values {
                    let mut request = example.clone();
                    request["scene"][list][0][field] = value;
                    if field == "x" || field == "y" {
                        request["frame"] = json!({"side": 1e9});
                    }
                    assert_eq!(rest.post("/v1/act", &request).await.0.is_success(), fits, "{request}");
                }
            }
            if field == "id" {
                let longest = schema["maxLength"].as_u64().unwrap() as usize;
                for (length, fits) in [(longest, true), (longest + 1, false)] {
                    let mut request = example.clone();
                    // Characters are counted, as schemas count, whatever their bytes.
                    request["scene"][list][0]["id"] = "ü".repeat(length).into();
                    assert_eq!(rest.post("/v1/act", &request).await.0.is_success(), fits, "{length}");
                }
            }
        }
    }
}

#[tokio::test]
async fn the_page_brings_all_its_parts() {
    let server = Server::start().await;
    let page = Rest::new(&server).get("/docs").await.1;
    let page = page.as_str().unwrap();
    assert!(!page.contains("//"), "nothing from elsewhere");
    let mut parts = 0;
    for part in page.split("=\"docs/").skip(1).map(|rest| rest.split('"').next().unwrap()) {
        let answer = Client::new().get(server.url(&format!("/docs/{part}"))).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK, "{part}");
        assert!(!answer.bytes().await.unwrap().is_empty());
        parts += 1;
    }
    assert_eq!(parts, 5);
    let (status, script) = Rest::new(&server).get("/docs/swagger-initializer.js").await;
    assert!(status.is_success() && script.as_str().unwrap().contains("\"url\": \"openapi.json\""), "{script}");
    assert_eq!(Rest::new(&server).get("/docs/..%2f..%2fCargo.toml").await.0, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn other_methods_and_other_bodies_are_told_what_would_do() {
    let server = Server::start().await;
    for (method, path, allowed) in [
        (Method::GET, "/v1/act", "POST"),
        (Method::POST, "/v1/policies/qedgix/aliases/live", "DELETE,PUT"),
        (Method::DELETE, "/v1/jobs", "GET,HEAD,POST"),
    ] {
        let answer = Client::new().request(method, server.url(path)).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::METHOD_NOT_ALLOWED);
        let mut told: Vec<&str> = answer.headers()["allow"].to_str().unwrap().split(',').collect();
        told.sort_unstable();
        assert_eq!(told.join(","), allowed, "{path}");
    }
    let send = |kind: &'static str| {
        let request = Client::new().post(server.url("/v1/sessions")).header("content-type", kind);
        request.body(r#"{"policy": "sweep"}"#).send()
    };
    for (kind, status) in [
        ("application/json", 201),
        ("Application/JSON; charset=utf-8", 201),
        ("application/x-www-form-urlencoded", 415),
        ("text/plain", 415),
        ("", 415),
    ] {
        assert_eq!(send(kind).await.unwrap().status().as_u16(), status, "{kind:?}");
    }
}
