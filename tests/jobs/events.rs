//! Watching a job: every change of state and every metric once, in order, on both transports, across restarts.

use std::collections::BTreeMap;
use std::path::Path;

use qedgix::store::{JobEventKind, JobState, Store};
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqlitePool};
use tonic::Code;

use super::harness::{MAX_WATCHERS, Rest, Server, Worker, expect, named, signed, tiny, within};
use super::processes::Process;

/// A server-sent event.
#[derive(Clone, Debug, PartialEq)]
struct Event {
    id: u64,
    name: String,
    data: Value,
}

/// A stream of server-sent events.
struct Events {
    response: reqwest::Response,
    text: String,
    /// Comments seen so far.
    comments: usize,
}

impl Events {
    async fn open(rest: &Rest, id: &str, last: Option<u64>) -> Self {
        let mut request = rest.request(Method::GET, &format!("/v1/jobs/{id}/events"));
        if let Some(last) = last {
            request = request.header("last-event-id", last.to_string());
        }
        let response = request.send().await.unwrap();
        assert_eq!(response.status(), StatusCode::OK);
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        Self { response, text: String::new(), comments: 0 }
    }

    /// The next event; `None` at the end of the stream.
    async fn next(&mut self) -> Option<Event> {
        loop {
            while let Some(end) = self.text.find("\n\n") {
                let block: String = self.text.drain(..end + 2).collect();
                let mut fields = BTreeMap::new();
                for line in block.lines().filter(|line| !line.is_empty()) {
                    let (field, value) = line.split_once(':').unwrap();
                    fields.insert(field.to_owned(), value.trim_start().to_owned());
                }
                if fields.remove("").is_some() {
                    assert!(fields.is_empty(), "{block}");
                    self.comments += 1;
                    continue;
                }
                let data = serde_json::from_str(&fields["data"]).unwrap();
                return Some(Event { id: fields["id"].parse().unwrap(), name: fields["event"].clone(), data });
            }
            let piece = within(self.response.chunk()).await.ok().flatten()?;
            self.text += std::str::from_utf8(&piece).unwrap();
        }
    }

    async fn rest(mut self) -> Vec<Event> {
        let mut events = Vec::new();
        while let Some(event) = self.next().await {
            events.push(event);
        }
        events
    }
}

async fn all(rest: &Rest, id: &str, last: Option<u64>) -> Vec<Event> {
    Events::open(rest, id, last).await.rest().await
}

fn row(name: &str, step: u64, value: f64) -> v1::ReportedMetric {
    v1::ReportedMetric { name: name.into(), step, value }
}

async fn report(server: &Server, worker: &Worker, metrics: Vec<v1::ReportedMetric>) {
    let step = metrics.iter().map(|m| m.step).max().unwrap_or(0);
    let request = signed(&worker.launch, &worker.launch.token, v1::ReportRequest { metrics, step });
    server.worker_client().await.report(request).await.unwrap();
}

async fn finish(server: &Server, worker: &Worker) {
    let request = v1::FinishRequest { outcome: v1::Outcome::Succeeded.into(), ..Default::default() };
    server.worker_client().await.finish(signed(&worker.launch, &worker.launch.token, request)).await.unwrap();
}

/// Events in short: the new state, or name, step and value of each metric.
fn brief(events: &[Event]) -> Vec<Value> {
    let of = |event: &Event| match event.name.as_str() {
        "state" => event.data["state"].clone(),
        "metrics" => {
            event.data["metrics"].as_array().unwrap().iter().map(|m| json!([m["name"], m["step"], m["value"]])).collect()
        }
        name => panic!("{name}"),
    };
    events.iter().map(of).collect()
}

async fn started() -> (tempfile::TempDir, Server, String, Worker) {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 2).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    (dir, server, id, worker)
}

#[tokio::test]
async fn both_transports_stream_all_events_of_a_job() {
    let (_dir, server, id, worker) = started().await;
    let mut live = Events::open(&server, &id, None).await;
    let mut grpc = server.jobs().await;
    let watch = |after| v1::WatchJobRequest { id: id.clone(), after };
    let mut messages = grpc.watch_job(watch(0)).await.unwrap().into_inner();
    // Each event is received before the next one is caused.
    let mut events = vec![live.next().await.unwrap(), live.next().await.unwrap()];
    report(&server, &worker, vec![row("loss", 20, 0.5), row("epsilon", 20, 1.0)]).await;
    events.push(live.next().await.unwrap());
    report(&server, &worker, vec![row("loss", 40, f64::NAN)]).await;
    events.push(live.next().await.unwrap());
    finish(&server, &worker).await;
    events.extend(live.rest().await);
    let expected = json!(["queued", "running", [["epsilon", 20, 1.0], ["loss", 20, 0.5]], [["loss", 40, null]], "succeeded"]);
    assert_eq!(json!(brief(&events)), expected);
    assert!(events.windows(2).all(|pair| pair[0].id < pair[1].id), "{events:?}");
    assert_eq!((&events[0].data["attempt"], &events[1].data["attempt"]), (&json!(0), &json!(1)));

    let mut again = Vec::new();
    while let Some(message) = within(messages.message()).await.unwrap() {
        again.push(message);
    }
    assert_eq!(again.iter().map(|m| m.id).collect::<Vec<_>>(), events.iter().map(|e| e.id).collect::<Vec<_>>());
    for (message, event) in again.iter().zip(&events) {
        match message.what.as_ref().unwrap() {
            v1::job_event::What::State(state) => {
                assert_eq!(
                    state.state().as_str_name(),
                    format!("JOB_STATE_{}", event.data["state"].as_str().unwrap().to_uppercase())
                );
                assert_eq!(state.attempt, event.data["attempt"].as_u64().unwrap() as u32);
            }
            v1::job_event::What::Metrics(metrics) => {
                let rows: Vec<Value> = metrics.rows.iter().map(|m| json!([m.name, m.step, m.value])).collect();
                assert_eq!(vec![json!(rows)], brief(std::slice::from_ref(event)));
            }
        }
    }

    // A watch after any event returns exactly the later events, on both transports.
    let job = server.get(&format!("/v1/jobs/{id}")).await;
    assert_eq!(job["last_event_id"], events.last().unwrap().id);
    for (i, event) in events.iter().enumerate().take(events.len() - 1) {
        assert_eq!(all(&server, &id, Some(event.id)).await, events[i + 1..]);
        let mut messages = grpc.watch_job(watch(event.id)).await.unwrap().into_inner();
        assert_eq!(messages.message().await.unwrap().unwrap(), again[i + 1]);
    }
    let by_query = server.request(Method::GET, &format!("/v1/jobs/{id}/events?after={}", events[2].id)).send().await.unwrap();
    assert!(by_query.text().await.unwrap().starts_with(&format!("id: {}\n", events[3].id)));
    // After the last event there is nothing to wait for. A browser stops reconnecting on 204.
    let over = server.request(Method::GET, &format!("/v1/jobs/{id}/events")).header("last-event-id", events[4].id.to_string());
    assert_eq!(over.send().await.unwrap().status(), StatusCode::NO_CONTENT);
    let mut messages = grpc.watch_job(watch(events[4].id)).await.unwrap().into_inner();
    assert_eq!(messages.message().await.unwrap(), None);
}

#[tokio::test]
async fn invalid_watch_requests_are_refused() {
    let (_dir, server, id, _worker) = started().await;
    let path = format!("/v1/jobs/{id}/events");
    for last in ["", "x", "-1", "1.5", "3", "18446744073709551616"] {
        let request = server.request(Method::GET, &path).header("last-event-id", last);
        let problem = expect(request, StatusCode::BAD_REQUEST).await;
        assert_eq!(problem["code"], "invalid_argument", "{last}: {problem}");
    }
    expect(server.request(Method::GET, &format!("{path}?since=1")), StatusCode::BAD_REQUEST).await;
    for nobody in ["1", &uuid::Uuid::now_v7().to_string()] {
        expect(server.request(Method::GET, &format!("/v1/jobs/{nobody}/events")), StatusCode::NOT_FOUND).await;
    }
    let mut grpc = server.jobs().await;
    let refused = grpc.watch_job(v1::WatchJobRequest { id: id.clone(), after: 3 }).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument, "{refused}");
    let refused = grpc.watch_job(v1::WatchJobRequest { id: "nobody".into(), after: 0 }).await.unwrap_err();
    assert_eq!(refused.code(), Code::NotFound, "{refused}");
}

#[tokio::test]
async fn metric_is_sent_again_only_when_its_value_changes() {
    let (_dir, mut server, id, worker) = started().await;
    let mut live = Events::open(&server, &id, Some(2)).await;
    report(&server, &worker, vec![row("loss", 20, 0.5), row("speed", 20, 100.0)]).await;
    // The response was lost, so the worker repeats the report.
    report(&server, &worker, vec![row("loss", 20, 0.5), row("speed", 20, 100.0)]).await;
    report(&server, &worker, vec![row("loss", 40, 0.25)]).await;
    // Read before the next worker reports, because a changed metric belongs to its last report only.
    let mut events = vec![live.next().await.unwrap(), live.next().await.unwrap()];
    // The worker dies. The next one repeats the last steps and continues.
    worker.exit("killed by signal 9");
    let worker = server.worker().await;
    report(&server, &worker, vec![row("loss", 20, 0.5), row("speed", 20, 90.0), row("loss", 40, 0.25)]).await;
    report(&server, &worker, vec![row("loss", 60, 0.125)]).await;
    while events.len() < 6 {
        events.push(live.next().await.unwrap());
    }
    let expected = json!([
        [["loss", 20, 0.5], ["speed", 20, 100.0]],
        [["loss", 40, 0.25]],
        "queued",
        "running",
        [["speed", 20, 90.0]],
        [["loss", 60, 0.125]]
    ]);
    assert_eq!(json!(brief(&events)), expected);
    assert!(events[2].data["reason"].as_str().unwrap().contains("signal 9"), "{:?}", events[2]);
    // A new watch returns every metric once, with its current value.
    let mut late = Events::open(&server, &id, Some(2)).await;
    let first = late.next().await.unwrap();
    assert_eq!(json!(brief(&[first])), json!([[["loss", 20, 0.5]]]));
}

#[tokio::test]
async fn long_histories_are_streamed_with_every_report_complete() {
    let (_dir, server, id, worker) = started().await;
    // Open, but not read while the events are written.
    let mut slow = Events::open(&server, &id, None).await;
    let mut grpc = server.jobs().await;
    let mut messages = grpc.watch_job(v1::WatchJobRequest { id: id.clone(), after: 0 }).await.unwrap().into_inner();
    // One event with more rows than a page, one that does not fit on its page, and many small ones.
    let sizes: Vec<u64> = [600, 9_000, 999, 1000, 1].into_iter().chain(std::iter::repeat_n(70, 40)).collect();
    for (i, &size) in sizes.iter().enumerate() {
        let step = i as u64;
        report(&server, &worker, (0..size).map(|j| row(&format!("metric-{j}"), step, j as f64)).collect()).await;
    }
    finish(&server, &worker).await;
    let events = {
        let mut events = Vec::new();
        while let Some(event) = slow.next().await {
            events.push(event);
        }
        events
    };
    assert_eq!(events.len(), sizes.len() + 3);
    for (i, &size) in sizes.iter().enumerate() {
        let rows = events[i + 2].data["metrics"].as_array().unwrap();
        assert_eq!(rows.len() as u64, size);
        assert!(rows.iter().all(|row| row["step"] == i));
    }
    assert_eq!(all(&server, &id, None).await, events);
    let mut ids = Vec::new();
    while let Some(message) = within(messages.message()).await.unwrap() {
        ids.push(message.id);
    }
    assert_eq!(ids, events.iter().map(|event| event.id).collect::<Vec<_>>());
}

#[tokio::test]
async fn stream_without_events_sends_heartbeats() {
    let (_dir, server, id, _worker) = started().await;
    let mut events = Events::open(&server, &id, Some(2)).await;
    let waiting = async {
        while events.comments < 2 {
            // The timeout does not affect the stream.
            let _ = tokio::time::timeout(std::time::Duration::from_millis(20), events.next()).await;
        }
    };
    within(waiting).await;
}

#[tokio::test]
async fn number_of_watches_is_limited_and_permits_are_returned() {
    let (_dir, server, id, _worker) = started().await;
    let mut grpc = server.jobs().await;
    let request = || v1::WatchJobRequest { id: id.clone(), after: 0 };
    let mut watching = Vec::new();
    for _ in 1..MAX_WATCHERS {
        let mut messages = grpc.watch_job(request()).await.unwrap().into_inner();
        messages.message().await.unwrap().unwrap();
        watching.push(messages);
    }
    let events = Events::open(&server, &id, None).await;
    let refused = grpc.watch_job(request()).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    let refused = server.request(Method::GET, &format!("/v1/jobs/{id}/events")).send().await.unwrap();
    assert_eq!(refused.status(), StatusCode::TOO_MANY_REQUESTS);
    assert!(refused.headers().contains_key("retry-after"));
    let metrics = server.request(Method::GET, "/metrics").send().await.unwrap().text().await.unwrap();
    assert!(metrics.contains("\nqedgix_job_watchers "), "{metrics}");
    drop((watching, events));
    within(async {
        while server.app.watchers.open() > 0 {
            tokio::task::yield_now().await;
        }
    })
    .await;
    grpc.watch_job(request()).await.unwrap();
}

#[tokio::test]
async fn draining_ends_watches_and_refuses_new_ones() {
    let (_dir, server, id, worker) = started().await;
    let mut grpc = server.jobs().await;
    let mut messages = grpc.watch_job(v1::WatchJobRequest { id: id.clone(), after: 1 }).await.unwrap().into_inner();
    assert_eq!(messages.message().await.unwrap().unwrap().id, 2);
    let mut events = Events::open(&server, &id, None).await;
    assert_eq!(events.next().await.unwrap().id, 1);
    server.app.draining.begin();
    let status = within(messages.message()).await.unwrap_err();
    assert_eq!((status.code(), status.metadata().get("qedgix-code").unwrap().to_str().unwrap()), (Code::Unavailable, "draining"));
    let rest = events.rest().await;
    assert!(rest.len() <= 1, "{rest:?}");
    let refused = server.request(Method::GET, &format!("/v1/jobs/{id}/events"));
    assert_eq!(expect(refused, StatusCode::SERVICE_UNAVAILABLE).await["code"], "draining");
    drop(worker);
}

#[tokio::test]
async fn watch_resumes_after_a_crash_of_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&named("long")).await;
    let worker = server.worker().await;
    report(&server, &worker, vec![row("loss", 20, 0.5)]).await;
    let mut live = Events::open(&server, &id, None).await;
    let mut events = Vec::new();
    while events.len() < 3 {
        events.push(live.next().await.unwrap());
    }
    report(&server, &worker, vec![row("loss", 40, 0.25)]).await;
    server.crash().await;
    drop(live);

    let mut server = Server::start(dir.path(), 1).await;
    let mut live = Events::open(&server, &id, Some(events[2].id)).await;
    let worker = server.worker().await;
    report(&server, &worker, vec![row("loss", 40, 0.25), row("loss", 60, 0.125)]).await;
    finish(&server, &worker).await;
    while let Some(event) = live.next().await {
        events.push(event);
    }
    let expected = json!([
        "queued",
        "running",
        [["loss", 20, 0.5]],
        [["loss", 40, 0.25]],
        "queued",
        "running",
        [["loss", 60, 0.125]],
        "succeeded"
    ]);
    assert_eq!(json!(brief(&events)), expected);
    assert_eq!(all(&server, &id, None).await, events);
}

#[tokio::test]
async fn killed_server_loses_and_duplicates_no_event() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Process::start(dir.path()).await;
    let id = server.rest.submit(&tiny()).await;
    let mut live = Events::open(&server.rest, &id, None).await;
    let mut events = Vec::new();
    while !events.iter().any(|event: &Event| event.name == "metrics") {
        events.push(live.next().await.unwrap());
    }
    server.kill();
    // Events that the server had sent.
    while let Some(event) = live.next().await {
        events.push(event);
    }
    let server = Process::start(dir.path()).await;
    events.extend(all(&server.rest, &id, Some(events.last().unwrap().id)).await);
    assert_eq!(events.last().unwrap().data["state"], "succeeded");
    assert!(events.windows(2).all(|pair| pair[0].id < pair[1].id), "{events:?}");
    // Every metric was sent, and its current value was sent last.
    let mut sent = BTreeMap::new();
    for metric in events.iter().filter_map(|event| event.data["metrics"].as_array()).flatten() {
        sent.insert((metric["name"].to_string(), metric["step"].as_u64().unwrap()), metric["value"].clone());
    }
    let kept = server.rest.get(&format!("/v1/jobs/{id}/metrics?page_size=100000")).await;
    let kept: BTreeMap<_, _> = kept["metrics"]
        .as_array()
        .unwrap()
        .iter()
        .map(|m| ((m["name"].to_string(), m["step"].as_u64().unwrap()), m["value"].clone()))
        .collect();
    assert_eq!(sent, kept);
    // A new watch returns the same states.
    let states = |events: &[Event]| events.iter().filter(|e| e.name == "state").cloned().collect::<Vec<_>>();
    assert_eq!(states(&all(&server.rest, &id, None).await), states(&events));
}

/// A database of a version in which events had no ids.
async fn old_database(dir: &Path) -> SqlitePool {
    let migrations = tempfile::tempdir().unwrap();
    for file in ["0001_jobs.sql", "0002_policies.sql"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations").join(file);
        std::fs::copy(from, migrations.path().join(file)).unwrap();
    }
    let options = SqliteConnectOptions::new().filename(dir.join(qedgix::store::FILE)).create_if_missing(true);
    let pool = SqlitePool::connect_with(options).await.unwrap();
    Migrator::new(migrations.path()).await.unwrap().run(&pool).await.unwrap();
    pool
}

#[tokio::test]
async fn migration_orders_the_events_of_an_older_database() {
    let dir = tempfile::tempdir().unwrap();
    let old = old_database(dir.path()).await;
    let script = "
        INSERT INTO jobs (number, id, state, spec, threads, priority, created_at) VALUES
            (1, 'a', 'succeeded', '{}', 1, 0, 10), (2, 'b', 'queued', '{}', 1, 0, 10);
        INSERT INTO events (job, at, state, attempt) VALUES
            (1, 10, 'queued', 0), (2, 10, 'queued', 0), (1, 10, 'running', 1), (1, 30, 'succeeded', 1);
        INSERT INTO metrics (job, name, step, value, at) VALUES
            (1, 'loss', 1, 0.5, 10), (1, 'loss', 2, 0.25, 20), (1, 'epsilon', 2, 1.0, 20), (1, 'loss', 3, 0.125, 30);
    ";
    for statement in script.split(';').filter(|s| !s.trim().is_empty()) {
        sqlx::query(sqlx::AssertSqlSafe(statement)).execute(&old).await.unwrap();
    }
    old.close().await;
    let store = Store::open(dir.path()).await.unwrap();
    let brief = |events: Vec<qedgix::store::JobEvent>| -> Vec<(u64, String)> {
        let of = |what| match what {
            JobEventKind::State { state, .. } => state.to_string(),
            JobEventKind::Metrics(rows) => rows.iter().map(|r| format!("{}@{}", r.name, r.step)).collect::<Vec<_>>().join(" "),
        };
        events.into_iter().map(|event| (event.id, of(event.kind))).collect()
    };
    let events = brief(store.events(1, 0).await.unwrap());
    let expected = ["queued", "running", "loss@1", "epsilon@2 loss@2", "loss@3", "succeeded"];
    assert_eq!(events, (1..).zip(expected.map(str::to_owned)).collect::<Vec<_>>());
    assert_eq!(brief(store.events(1, 4).await.unwrap()), events[4..]);
    assert_eq!(brief(store.events(2, 0).await.unwrap()), [(1, JobState::Queued.to_string())]);
}
