//! Submitting, listing and deleting jobs; invalid requests; idempotency; both transports.

use std::time::Duration;

use prost_types::value::Kind;
use qedgix::api::convert::structs::to_struct;
use qedgix::jobs::SchedulerConfig;
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tonic::Code;

use super::harness::{Server, expect, named, tiny, with};

async fn server() -> (tempfile::TempDir, Server) {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), 2).await;
    (dir, server)
}

#[tokio::test]
async fn job_shows_its_configuration_which_can_be_submitted_again() {
    let (_dir, server) = server().await;
    let id = server.submit(&with(&json!({"name": "first", "labels": {"who": "me"}, "seed": 7}))).await;
    let job = server.get(&format!("/v1/jobs/{id}")).await;
    assert_eq!(job["environment"]["detection_range"], 0.28);
    assert_eq!(job["training"]["steps"], 400);
    assert_eq!(job["training"]["mixer"], "vdn");
    assert_eq!((&job["seed"], &job["labels"]["who"], &job["kind"]), (&json!(7), &json!("me"), &json!("train")));
    assert_eq!(job["progress"], json!({"step": 0, "steps": 400, "steps_per_second": null, "seconds_left": null}));

    let fields = ["kind", "algorithm", "preset", "environment", "training", "threads", "priority", "seed", "name", "labels"];
    let again: Value = fields.iter().map(|f| ((*f).to_owned(), job[f].clone())).collect::<serde_json::Map<_, _>>().into();
    let twin = server.submit(&again).await;
    let twin = server.get(&format!("/v1/jobs/{twin}")).await;
    for field in fields {
        assert_eq!(twin[field], job[field]);
    }
}

#[tokio::test]
async fn invalid_requests_return_the_documented_errors() {
    let (_dir, server) = server().await;
    let post =
        |body: &str| server.request(Method::POST, "/v1/jobs").header("content-type", "application/json").body(body.to_owned());
    let cases = [
        ("{\"seed\": 1", 400, "invalid_argument"),
        ("{} {}", 400, "invalid_argument"),
        ("[]", 422, "invalid_schema"),
        ("{\"sede\": 1}", 422, "invalid_schema"),
        ("{\"environment\": {\"uvas\": 1}}", 422, "invalid_schema"),
        ("{\"threads\": \"two\"}", 422, "invalid_schema"),
        ("{\"threads\": 3}", 400, "invalid_argument"),
        ("{\"kind\": \"sweep\"}", 400, "invalid_argument"),
        ("{\"kind\": \"evaluate\", \"evaluation\": {\"policies\": 3}}", 422, "invalid_schema"),
        ("{\"name\": \"random\"}", 400, "invalid_argument"),
        ("{\"environment\": {\"uavs\": 0}}", 400, "invalid_argument"),
    ];
    for (body, status, code) in cases {
        let problem = expect(post(body), StatusCode::from_u16(status).unwrap()).await;
        assert_eq!(problem["code"], code, "{body}: {problem}");
    }
    let large = post(&format!("{{\"name\": \"{}\"}}", "x".repeat(20 << 20)));
    expect(large, StatusCode::PAYLOAD_TOO_LARGE).await;
    let problem = expect(post("{\"threads\": 3}"), StatusCode::BAD_REQUEST).await;
    assert_eq!((&problem["field"], &problem["value"]), (&json!("threads"), &json!("3")), "{problem}");

    for query in ["state=resting", "page_size=1001", "page_size=-1", "page_token=x", "colour=red"] {
        expect(server.request(Method::GET, &format!("/v1/jobs?{query}")), StatusCode::BAD_REQUEST).await;
    }
    let id = server.submit(&tiny()).await;
    for query in ["format=xml", "page_size=100001", "page_token=loss", "nam=loss"] {
        let path = format!("/v1/jobs/{id}/metrics?{query}");
        expect(server.request(Method::GET, &path), StatusCode::BAD_REQUEST).await;
    }
}

#[tokio::test]
async fn unknown_ids_are_not_found() {
    let (_dir, server) = server().await;
    let absent = uuid::Uuid::now_v7().to_string();
    for id in ["1", "..%2f", &absent, &absent.to_uppercase()] {
        for (method, verb) in [
            (Method::GET, ""),
            (Method::DELETE, ""),
            (Method::POST, "/cancel"),
            (Method::POST, "/pause"),
            (Method::POST, "/resume"),
            (Method::GET, "/metrics"),
            (Method::GET, "/checkpoints"),
            (Method::GET, "/logs"),
        ] {
            let problem = expect(server.request(method, &format!("/v1/jobs/{id}{verb}")), StatusCode::NOT_FOUND).await;
            assert_eq!(problem["code"], "not_found");
        }
        expect(server.request(Method::GET, &format!("/v1/checkpoints/{id}")), StatusCode::NOT_FOUND).await;
    }
}

#[tokio::test]
async fn idempotency_key_creates_one_job() {
    let (_dir, server) = server().await;
    let submit = |spec: Value| server.request(Method::POST, "/v1/jobs").header("idempotency-key", "k1").json(&spec);
    let first = expect(submit(tiny()), StatusCode::CREATED).await;
    let again = expect(submit(tiny()), StatusCode::CREATED).await;
    assert_eq!(first["id"], again["id"]);
    let conflict = expect(submit(with(&json!({"seed": 2}))), StatusCode::CONFLICT).await;
    assert_eq!(conflict["code"], "idempotency_conflict");
    assert_eq!(server.get("/v1/jobs").await["jobs"].as_array().unwrap().len(), 1);

    // The same key and body on the other transport.
    let mut grpc = server.jobs().await;
    let request = |spec: Value| v1::SubmitJobRequest { spec: to_struct(&spec), idempotency_key: "k1".into() };
    let same = grpc.submit_job(request(tiny())).await.unwrap().into_inner();
    assert_eq!(first["id"], same.id);
    let status = grpc.submit_job(request(with(&json!({"seed": 2})))).await.unwrap_err();
    assert_eq!(status.code(), Code::AlreadyExists);
}

#[tokio::test]
async fn a_repeated_request_returns_its_job_whatever_the_server_accepts_now() {
    let dir = tempfile::tempdir().unwrap();
    let wide = with(&json!({"threads": 2}));
    let submit = |server: &Server, spec: &Value, key: &str| {
        server.request(Method::POST, "/v1/jobs").header("idempotency-key", key).json(spec)
    };
    let mut server = Server::start(dir.path(), 2).await;
    let first = expect(submit(&server, &wide, "k1"), StatusCode::CREATED).await;
    server.crash().await;

    // The new server has a smaller CPU budget and less memory.
    let shrink = |s: &mut SchedulerConfig| s.memory = 1 << 10;
    let server = Server::start_with(dir.path(), 1, shrink).await;
    let again = expect(submit(&server, &wide, "k1"), StatusCode::CREATED).await;
    assert_eq!(first["id"], again["id"]);
    let refused = expect(submit(&server, &wide, "k2"), StatusCode::BAD_REQUEST).await;
    assert_eq!(refused["field"], "threads");
    // The same key with another body is a conflict, also when the server would refuse that body.
    let other = with(&json!({"threads": 9}));
    let conflict = expect(submit(&server, &other, "k1"), StatusCode::CONFLICT).await;
    assert_eq!(conflict["code"], "idempotency_conflict");
}

#[tokio::test]
async fn a_job_that_needs_more_memory_than_there_is_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_with(dir.path(), 2, |s| s.memory = 1 << 30).await;
    for (field, fields) in [
        ("training.buffer", json!({"training": {"buffer": 1_000_000, "steps": 1_000_000_000}})),
        ("environment.uavs", json!({"environment": {"uavs": 1000, "users": 900}, "training": {"buffer": 100}})),
    ] {
        let refused = server.request(Method::POST, "/v1/jobs").json(&fields);
        let refused = expect(refused, StatusCode::BAD_REQUEST).await;
        assert_eq!((&refused["code"], &refused["field"]), (&json!("invalid_argument"), &json!(field)), "{refused}");
        assert!(refused["expected"].as_str().unwrap().contains("1024 MiB"), "{refused}");
        let mut grpc = server.jobs().await;
        let request = v1::SubmitJobRequest { spec: to_struct(&fields), ..Default::default() };
        assert_eq!(grpc.submit_job(request).await.unwrap_err().code(), Code::InvalidArgument);
    }
    server.submit(&tiny()).await;
}

#[tokio::test]
async fn both_transports_accept_and_refuse_the_same() {
    let (_dir, server) = server().await;
    let mut grpc = server.jobs().await;
    let job = grpc.submit_job(v1::SubmitJobRequest { spec: to_struct(&named("twin")), ..Default::default() }).await.unwrap();
    let job = job.into_inner();
    let rest = server.get(&format!("/v1/jobs/{}", job.id)).await;
    let expected = to_struct(&rest).unwrap().fields;
    for (name, value) in job.spec.unwrap().fields {
        assert_eq!(expected[&name], value, "{name}");
    }
    let refused = |spec: Value| {
        let mut grpc = grpc.clone();
        async move {
            let request = v1::SubmitJobRequest { spec: to_struct(&spec), ..Default::default() };
            grpc.submit_job(request).await.unwrap_err()
        }
    };
    for spec in [json!({"sede": 1}), json!({"threads": 3}), json!({"seed": 1.5}), json!({"kind": "evaluate"})] {
        let status = refused(spec.clone()).await;
        assert_eq!(status.code(), Code::InvalidArgument, "{spec}");
    }
    let missing = grpc.get_job(v1::GetJobRequest { id: "nobody".into() }).await.unwrap_err();
    assert_eq!(missing.code(), Code::NotFound);
}

#[tokio::test]
async fn jobs_are_listed_newest_first_page_by_page() {
    let (_dir, server) = server().await;
    let mut expected = Vec::new();
    for i in 0..5 {
        expected.insert(0, server.submit(&named(&format!("job-{i}"))).await);
    }
    let (mut seen, mut path) = (Vec::new(), "/v1/jobs?page_size=2".to_owned());
    loop {
        let page = server.get(&path).await;
        seen.extend(page["jobs"].as_array().unwrap().iter().map(|job| job["id"].as_str().unwrap().to_owned()));
        let token = page["next_page_token"].as_str().unwrap();
        if token.is_empty() {
            break;
        }
        path = format!("/v1/jobs?page_size=2&page_token={token}");
    }
    assert_eq!(seen, expected);
    let mut grpc = server.jobs().await;
    let page = grpc.list_jobs(v1::ListJobsRequest { page_size: 2, ..Default::default() }).await.unwrap().into_inner();
    assert_eq!(page.jobs.iter().map(|job| &job.id).collect::<Vec<_>>(), [&expected[0], &expected[1]]);
    assert!(!page.next_page_token.is_empty());
}

#[tokio::test]
async fn lists_are_bounded_in_bytes() {
    const MAX_BYTES: usize = (1 << 20) + (64 << 10);
    let (_dir, server) = server().await;
    let layout: Vec<[f64; 2]> = (0..20_000).map(|i| [f64::from(i) / 20_000.0, 0.123_456_789_012_345_6]).collect();
    let labels: std::collections::BTreeMap<String, String> =
        (0..32).map(|i| (format!("label-{i}"), "\u{1F6E9}".repeat(255))).collect();
    let large = server.submit(&with(&json!({"environment": {"users": layout.len(), "layout": {"given": layout}}}))).await;
    assert!(server.get(&format!("/v1/jobs/{large}")).await["environment"]["layout"]["given"][19_999].is_array());
    let mut expected = vec![large];
    for _ in 0..40 {
        expected.push(server.submit(&with(&json!({"labels": labels, "seed": 7}))).await);
    }
    expected.reverse();

    let (mut listed, mut pages, mut token) = (Vec::new(), 0, String::new());
    loop {
        let request = server.request(Method::GET, &format!("/v1/jobs?page_size=1000&page_token={token}"));
        let text = request.send().await.unwrap().text().await.unwrap();
        assert!(text.len() < MAX_BYTES, "{}", text.len());
        let page: Value = serde_json::from_str(&text).unwrap();
        for job in page["jobs"].as_array().unwrap() {
            assert!(job["environment"].is_null() && job["training"].is_null() && job["seed"].is_u64());
            listed.push(job["id"].as_str().unwrap().to_owned());
        }
        (pages, token) = (pages + 1, page["next_page_token"].as_str().unwrap().to_owned());
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(listed, expected);
    assert_eq!(pages, 2);

    let mut grpc = server.jobs().await;
    let first = grpc.list_jobs(v1::ListJobsRequest { page_size: 1000, ..Default::default() }).await.unwrap().into_inner();
    assert!(prost::Message::encoded_len(&first) < MAX_BYTES && !first.next_page_token.is_empty());
    let next = v1::ListJobsRequest { page_token: first.next_page_token, ..Default::default() };
    let next = grpc.list_jobs(next).await.unwrap().into_inner();
    assert!(
        next.next_page_token.is_empty() && !next.jobs.last().unwrap().spec.as_ref().unwrap().fields.contains_key("environment")
    );
    let ids: Vec<String> = first.jobs.into_iter().chain(next.jobs).map(|job| job.id).collect();
    assert_eq!(ids, expected);
}

#[tokio::test]
async fn seeds_are_exact_in_rest_and_refused_where_a_struct_rounds_them() {
    let (_dir, server) = server().await;
    let id = server.submit(&with(&json!({"seed": u64::MAX}))).await;
    assert_eq!(server.get(&format!("/v1/jobs/{id}")).await["seed"], u64::MAX);
    assert_eq!(server.get("/v1/jobs").await["jobs"][0]["seed"], u64::MAX);
    let mut grpc = server.jobs().await;
    let job = grpc.get_job(v1::GetJobRequest { id }).await.unwrap().into_inner();
    let spec = job.spec.unwrap();
    assert_eq!(spec.fields["seed"], prost_types::Value { kind: Some(Kind::StringValue(u64::MAX.to_string())) });

    let mut spec = to_struct(&tiny()).unwrap();
    let seed = Kind::NumberValue(9_007_199_254_740_992.0);
    spec.fields.insert("seed".into(), prost_types::Value { kind: Some(seed) });
    let status = grpc.submit_job(v1::SubmitJobRequest { spec: Some(spec), ..Default::default() }).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().starts_with("spec.seed: "), "{status}");
}

#[tokio::test]
async fn only_ended_jobs_can_be_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.cancel_grace = Duration::ZERO).await;
    let id = server.submit(&tiny()).await;
    let path = format!("/v1/jobs/{id}");
    let problem = expect(server.request(Method::DELETE, &path), StatusCode::CONFLICT).await;
    assert_eq!(problem["code"], "wrong_state");
    // Waits for the worker, because a queued job would be cancelled without one.
    let worker = server.worker().await;
    server.post(&format!("{path}/cancel")).await;
    worker.killed().await;
    server.reaches(&id, "cancelled").await;
    expect(server.request(Method::DELETE, &path), StatusCode::NO_CONTENT).await;
    expect(server.request(Method::GET, &path), StatusCode::NOT_FOUND).await;
}
