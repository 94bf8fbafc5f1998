//! Webhooks: receivers are told of the end of jobs.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Redirect, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use qedgix::wire::v1;
use reqwest::Method;
use serde_json::{Value, json};
use sha2::Sha256;
use tokio::sync::mpsc;

use super::harness::{Rest, Server, expect, named, signed, tiny, with, within};
use super::process::{Process, serve};

/// A message that arrived.
#[derive(Debug)]
struct Received {
    path: String,
    headers: HeaderMap,
    body: String,
}

impl Received {
    fn header(&self, name: &str) -> &str {
        self.headers[name].to_str().unwrap()
    }

    fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }
}

/// How a receiver answers its next messages; afterwards it accepts all.
type Answers = Arc<Mutex<VecDeque<Response>>>;

/// A receiver on a loopback address.
struct Receiver {
    url: String,
    received: mpsc::UnboundedReceiver<Received>,
    answers: Answers,
}

impl Receiver {
    async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/hook", listener.local_addr().unwrap());
        let (sender, received) = mpsc::unbounded_channel();
        let answers = Answers::default();
        let take = |State((sender, answers)): State<(mpsc::UnboundedSender<Received>, Answers)>,
                    uri: Uri,
                    headers: HeaderMap,
                    body: Bytes| async move {
            let body = String::from_utf8(body.to_vec()).unwrap();
            let _ = sender.send(Received { path: uri.path().to_owned(), headers, body });
            answers.lock().unwrap().pop_front().unwrap_or_else(|| StatusCode::NO_CONTENT.into_response())
        };
        let router = Router::new().fallback(take).with_state((sender, Arc::clone(&answers)));
        tokio::spawn(async move { axum::serve(listener, router).await });
        Self { url, received, answers }
    }

    fn will_answer(&self, answer: impl IntoResponse) {
        self.answers.lock().unwrap().push_back(answer.into_response());
    }

    async fn next(&mut self) -> Received {
        within(self.received.recv()).await.unwrap()
    }

    fn is_empty(&mut self) -> bool {
        self.received.try_recv().is_err()
    }
}

/// Waits until no message is left in the database.
async fn all_sent(server: &Server) {
    within(async {
        while server.app.store.next_webhook_message().await.unwrap().is_some() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

async fn finish(server: &mut Server, outcome: v1::Outcome) {
    let worker = server.worker().await;
    let request =
        v1::FinishRequest { outcome: outcome.into(), reason: "by the test".into(), permanent: true, ..Default::default() };
    let request = signed(&worker.launch, &worker.launch.token, request);
    server.worker_client().await.finish(request).await.unwrap();
    worker.exit("exit code 0");
}

#[tokio::test]
async fn every_end_is_told_once_and_signed() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let (mut all, mut failures) = (Receiver::start().await, Receiver::start().await);
    let webhooks = json!([{"url": all.url, "secret": "hunter2"}, {"url": failures.url, "events": ["failed"]}]);
    let id = server.submit(&with(&json!({"name": "told", "labels": {"a": "b"}, "webhooks": webhooks}))).await;
    finish(&mut server, v1::Outcome::Failed).await;
    server.reaches(&id, "failed").await;
    for (receiver, is_signed) in [(&mut all, true), (&mut failures, false)] {
        let message = receiver.next().await;
        assert_eq!((message.path.as_str(), message.header("content-type")), ("/hook", "application/json"));
        let document = message.json();
        assert_eq!(document["type"], "job.failed");
        let data = &document["data"];
        assert_eq!((&data["id"], &data["state"], &data["reason"]), (&json!(id), &json!("failed"), &json!("by the test")));
        assert_eq!((&data["name"], &data["kind"], &data["labels"]), (&json!("told"), &json!("train"), &json!({"a": "b"})));
        assert!(data["ended_at"].is_string());
        assert_eq!(message.headers.contains_key("webhook-signature"), is_signed);
        if is_signed {
            let mut mac = Hmac::<Sha256>::new_from_slice(b"hunter2").unwrap();
            let content = [message.header("webhook-id"), message.header("webhook-timestamp"), &message.body].join(".");
            mac.update(content.as_bytes());
            let expected = format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()));
            assert_eq!(message.header("webhook-signature"), expected);
        }
    }
    // A retry ends again.
    server.post(&format!("/v1/jobs/{id}/retry")).await;
    finish(&mut server, v1::Outcome::Succeeded).await;
    assert_eq!(all.next().await.json()["type"], "job.succeeded");
    all_sent(&server).await;
    assert!(all.is_empty() && failures.is_empty());

    // Nothing that the server answers contains the secret.
    let job = server.get(&format!("/v1/jobs/{id}")).await;
    let events = json!(["succeeded", "failed", "cancelled"]);
    let hidden = json!([
        {"url": all.url, "events": events, "signed": true},
        {"url": failures.url, "events": ["failed"], "signed": false},
    ]);
    assert_eq!(job["webhooks"], hidden);
    let grpc = server.jobs().await.get_job(v1::GetJobRequest { id: id.clone() }).await.unwrap().into_inner();
    assert!(!format!("{grpc:?}").contains("hunter2") && !job.to_string().contains("hunter2"));
    // Deleting a job does not delete what is to be told of it.
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), reqwest::StatusCode::NO_CONTENT).await;
}

#[tokio::test]
async fn a_message_is_repeated_until_it_is_accepted_and_follows_no_redirect() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let mut receiver = Receiver::start().await;
    receiver.will_answer(StatusCode::INTERNAL_SERVER_ERROR);
    receiver.will_answer(Redirect::temporary("/elsewhere"));
    let id = server.submit(&with(&json!({"webhooks": [{"url": receiver.url}]}))).await;
    finish(&mut server, v1::Outcome::Succeeded).await;
    let messages = [receiver.next().await, receiver.next().await, receiver.next().await];
    assert!(messages.iter().all(|message| message.path == "/hook"));
    assert!(messages.iter().all(|message| message.header("webhook-id") == messages[0].header("webhook-id")));
    assert!(messages.iter().all(|message| message.body == messages[0].body));
    all_sent(&server).await;
    // A receiver that is gone is not asked again.
    receiver.will_answer(StatusCode::GONE);
    server.submit(&with(&json!({"webhooks": [{"url": receiver.url}]}))).await;
    finish(&mut server, v1::Outcome::Succeeded).await;
    assert_ne!(receiver.next().await.header("webhook-id"), messages[0].header("webhook-id"));
    all_sent(&server).await;
    assert!(receiver.is_empty());
    server.reaches(&id, "succeeded").await;
}

#[tokio::test]
async fn a_sweep_is_told_and_not_its_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), 1).await;
    let mut receiver = Receiver::start().await;
    let mut sweep = named("gammas");
    sweep["kind"] = json!("sweep");
    sweep["sweep"] = json!({"grid": {"training.gamma": [0.5, 0.9]}});
    sweep["webhooks"] = json!([{"url": receiver.url, "events": ["cancelled"]}]);
    // Nothing starts before another job has ended.
    let blocker = server.submit(&tiny()).await;
    sweep["after"] = json!([blocker]);
    let id = server.submit(&sweep).await;
    server.post(&format!("/v1/jobs/{id}/cancel")).await;
    let message = receiver.next().await.json();
    assert_eq!((&message["data"]["id"], &message["data"]["kind"]), (&json!(id), &json!("sweep")));
    all_sent(&server).await;
    assert!(receiver.is_empty());
}

#[tokio::test]
async fn receivers_are_public_or_permitted() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), 1).await;
    let refused = async |webhook: Value| {
        let request = server.request(Method::POST, "/v1/jobs").json(&with(&json!({"webhooks": [webhook]})));
        expect(request, reqwest::StatusCode::BAD_REQUEST).await["field"].as_str().unwrap().to_owned()
    };
    for url in
        ["http://10.0.0.1/", "http://169.254.169.254/latest", "http://[::1]:80/", "http://localhost/", "gopher://example.org"]
    {
        assert_eq!(refused(json!({"url": url})).await, "webhooks[0].url", "{url}");
    }
    assert_eq!(refused(json!({"url": "http://127.0.0.1", "events": ["failed", "failed"]})).await, "webhooks[0].events[1]");
    // A name is looked up when the message is sent; then the job has ended, and only the message fails.
    server.submit(&with(&json!({"webhooks": [{"url": "https://hooks.invalid/"}]}))).await;
}

#[tokio::test]
async fn a_message_survives_the_death_of_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let mut receiver = Receiver::start().await;
    receiver.will_answer(StatusCode::SERVICE_UNAVAILABLE);
    let start = async || {
        let mut command = serve(dir.path());
        command.args(["--cpu-budget", "1", "--webhook-allow", "127.0.0.1"]);
        Process::start(command).await
    };
    let mut server = start().await;
    let rest = Rest::new(format!("http://{}", server.http));
    let id = rest.submit(&with(&json!({"webhooks": [{"url": receiver.url, "secret": "hunter2"}]}))).await;
    rest.post(&format!("/v1/jobs/{id}/cancel")).await;
    let first = receiver.next().await;
    server.kill();
    let _server = start().await;
    let second = receiver.next().await;
    assert_eq!(first.header("webhook-id"), second.header("webhook-id"));
    assert_eq!((first.body, second.headers.contains_key("webhook-signature")), (second.body, true));
}
