//! `/metrics`: valid Prometheus names and types, and exact counts.

use std::collections::{BTreeMap, BTreeSet};

use bytes::BufMut;
use futures::StreamExt;
use qedgix::wire::v1;
use serde_json::json;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use super::super::binary::Binary;
use super::super::harness::*;
use super::fly;

/// One family of metrics.
#[derive(Debug, Default)]
struct Family {
    kind: String,
    help: String,
    /// Name with labels, and value.
    samples: Vec<(String, BTreeMap<String, String>, f64)>,
}

fn is_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

fn sample(line: &str) -> (String, BTreeMap<String, String>, f64) {
    let (series, value) = line.rsplit_once(' ').unwrap();
    let (name, labels) = series.split_once('{').map_or((series, ""), |(name, labels)| (name, labels.strip_suffix('}').unwrap()));
    let mut known = BTreeMap::new();
    let mut rest = labels;
    while let Some((label, after)) = rest.split_once("=\"") {
        let (text, after) = after.split_once('"').unwrap();
        assert!(is_name(label) && !text.contains('\\'), "{line}");
        assert!(known.insert(label.to_owned(), text.to_owned()).is_none(), "{line}");
        rest = after.strip_prefix(',').unwrap_or(after);
    }
    assert!(rest.is_empty(), "{line}");
    (name.to_owned(), known, value.parse().unwrap_or_else(|_| panic!("{line}")))
}

/// Parses an exposition. Panics when a line is invalid or belongs to no declared family.
fn parse(text: &str) -> BTreeMap<String, Family> {
    let mut families: BTreeMap<String, Family> = BTreeMap::new();
    for line in text.lines().filter(|line| !line.is_empty()) {
        if let Some(help) = line.strip_prefix("# HELP ") {
            let (name, help) = help.split_once(' ').unwrap();
            let family = families.entry(name.to_owned()).or_default();
            assert!(family.help.is_empty() && family.kind.is_empty(), "{line}");
            help.clone_into(&mut family.help);
        } else if let Some(kind) = line.strip_prefix("# TYPE ") {
            let (name, kind) = kind.split_once(' ').unwrap();
            let family = families.entry(name.to_owned()).or_default();
            assert!(family.kind.is_empty() && family.samples.is_empty(), "{line}");
            kind.clone_into(&mut family.kind);
        } else {
            let sample = sample(line);
            let base = ["_bucket", "_sum", "_count"].iter().find_map(|suffix| {
                let base = sample.0.strip_suffix(suffix)?;
                families.get(base).filter(|family| family.kind == "histogram").map(|_| base.to_owned())
            });
            let family = base.unwrap_or_else(|| sample.0.clone());
            families.get_mut(&family).unwrap_or_else(|| panic!("of no family: {line}")).samples.push(sample);
        }
    }
    families
}

/// Checks the rules of the format and of `promtool check metrics`.
fn check(families: &BTreeMap<String, Family>) {
    for (name, family) in families {
        assert!(is_name(name), "{name}");
        assert!(family.help.len() > 10 && family.help.ends_with('.'), "{name}: help {:?}", family.help);
        assert!(!family.samples.is_empty(), "{name} has no samples");
        let total = name.ends_with("_total");
        match family.kind.as_str() {
            "counter" => assert!(total, "counters end in _total: {name}"),
            "gauge" | "histogram" => assert!(!total, "only counters end in _total: {name}"),
            kind => panic!("{name} is a {kind}"),
        }
        for suffix in ["_count", "_sum", "_bucket", "_info_total"] {
            assert!(!name.ends_with(suffix), "{name}");
        }
        for unit in ["ms", "milliseconds", "us", "minutes", "kb", "mb", "kilobytes", "percent"] {
            assert!(!name.split('_').any(|part| part == unit), "{name}: base units only");
        }
        let series: BTreeSet<_> = family.samples.iter().map(|(name, labels, _)| (name, labels)).collect();
        assert_eq!(series.len(), family.samples.len(), "{name}: the same series twice");
        if family.kind == "histogram" {
            check_histogram(name, family);
        }
    }
}

fn check_histogram(name: &str, family: &Family) {
    let mut by_labels: BTreeMap<BTreeMap<String, String>, (Vec<(f64, f64)>, BTreeMap<&str, f64>)> = BTreeMap::new();
    for (sample, labels, value) in &family.samples {
        let mut labels = labels.clone();
        let bound = labels.remove("le");
        let entry = by_labels.entry(labels).or_default();
        match (sample.strip_prefix(name).unwrap(), bound) {
            ("_bucket", Some(bound)) => entry.0.push((bound.parse().unwrap(), *value)),
            (part @ ("_sum" | "_count"), None) => assert!(entry.1.insert(part, *value).is_none()),
            other => panic!("{name}: {other:?}"),
        }
    }
    for (labels, (buckets, parts)) in by_labels {
        assert!(buckets.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 <= pair[1].1), "{name} {labels:?} {buckets:?}");
        let last = buckets.last().unwrap();
        assert_eq!((last.0, last.1), (f64::INFINITY, parts["_count"]), "{name} {labels:?}");
        assert!(parts["_sum"] >= 0.0);
    }
}

#[tokio::test]
async fn the_exposition_is_valid_and_contains_every_family() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &[]).await;
    fly(&binary, "s", 0).await;
    let job = reqwest::Client::new().post(format!("{}/v1/jobs", binary.http)).json(&json!({"threads": 1, "priority": -1}));
    assert_eq!(job.send().await.unwrap().status(), 201);
    let families = parse(&binary.metrics().await);
    // The second exposition counts the request of the first.
    let families = [families, parse(&binary.metrics().await)];
    families.iter().for_each(check);
    let has: BTreeSet<&str> = families[1].keys().map(String::as_str).collect();
    let expected = [
        "grpc_server_started_total",
        "grpc_server_handled_total",
        "grpc_server_handling_seconds",
        "grpc_server_msg_received_total",
        "grpc_server_msg_sent_total",
        "http_requests_total",
        "http_request_duration_seconds",
        "qedgix_act_queue_seconds",
        "qedgix_act_compute_seconds",
        "qedgix_act_batch_size",
        "qedgix_inference_count_total",
        "qedgix_inference_exec_count_total",
        "qedgix_inference_success_total",
        "qedgix_inference_failure_total",
        "qedgix_engine_queue_depth",
        "qedgix_session_memory_bytes",
        "qedgix_sessions",
        "qedgix_environments",
        "qedgix_policy_versions",
        "qedgix_jobs",
        "qedgix_jobs_submitted_total",
        "qedgix_job_watchers",
        "qedgix_training_threads",
        "qedgix_training_threads_busy",
        "qedgix_build_info",
        "process_cpu_seconds_total",
        "process_resident_memory_bytes",
        "process_open_fds",
        "process_threads",
        "process_start_time_seconds",
    ];
    for name in expected {
        assert!(has.contains(name), "{name} is not among {has:?}");
    }
    let [jobs, memory] = ["qedgix_jobs", "process_resident_memory_bytes"].map(|name| &families[1][name].samples);
    assert_eq!(jobs.iter().map(|(_, labels, _)| labels["state"].as_str()).collect::<BTreeSet<_>>().len(), 6);
    assert_eq!(jobs.iter().map(|sample| sample.2).sum::<f64>(), 1.0);
    assert!(memory[0].2 > 1e6);
}

/// Counts of one method: started, handled per code, timed, and messages.
#[derive(Debug, PartialEq)]
struct Calls {
    started: f64,
    handled: BTreeMap<String, f64>,
    timed: f64,
    received: f64,
    sent: f64,
}

fn calls(text: &str, service: &str, method: &str, kind: &str) -> Calls {
    let families = parse(text);
    let of = |family: &str, sample: &str| -> Vec<(BTreeMap<String, String>, f64)> {
        let Some(family) = families.get(family) else { return Vec::new() };
        let ours = family
            .samples
            .iter()
            .filter(|(name, labels, _)| name == sample && labels["grpc_service"] == service && labels["grpc_method"] == method);
        ours.map(|(_, labels, value)| {
            assert_eq!(labels["grpc_type"], kind);
            (labels.clone(), *value)
        })
        .collect()
    };
    let one = |name: &str| of(name, name).first().map_or(0.0, |(_, value)| *value);
    let handled = of("grpc_server_handled_total", "grpc_server_handled_total");
    Calls {
        started: one("grpc_server_started_total"),
        handled: handled.into_iter().map(|(labels, value)| (labels["grpc_code"].clone(), value)).collect(),
        timed: of("grpc_server_handling_seconds", "grpc_server_handling_seconds_count").first().map_or(0.0, |(_, n)| *n),
        received: one("grpc_server_msg_received_total"),
        sent: one("grpc_server_msg_sent_total"),
    }
}

fn counted(started: f64, handled: &[(&str, f64)], received: f64, sent: f64) -> Calls {
    let timed = handled.iter().map(|(_, n)| n).sum();
    Calls { started, handled: handled.iter().map(|&(code, n)| (code.to_owned(), n)).collect(), timed, received, sent }
}

/// A call on a connection of its own, whose frames the test sends.
async fn raw_stream(binary: &Binary, path: &str) -> (h2::SendStream<bytes::Bytes>, h2::client::ResponseFuture) {
    let socket = tokio::net::TcpStream::connect(binary.grpc.trim_start_matches("http://")).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    tokio::spawn(connection);
    let head = axum::http::Request::post(format!("{}{path}", binary.grpc));
    let head = head.header("content-type", "application/grpc").header("te", "trailers").body(()).unwrap();
    let (answer, questions) = client.ready().await.unwrap().send_request(head, false).unwrap();
    (questions, answer)
}

fn framed(message: &impl prost::Message) -> bytes::Bytes {
    let mut framed = bytes::BytesMut::new();
    framed.put_u8(0);
    framed.put_u32(message.encoded_len() as u32);
    message.encode(&mut framed).unwrap();
    framed.freeze()
}

const POLICIES: &str = "qedgix.v1.PolicyService";

#[tokio::test]
async fn grpc_calls_are_counted_with_their_final_status() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &[]).await;
    let mut client = binary.policies().await;
    client.open_session(open("sweep", "s")).await.unwrap();
    for step in 0..3 {
        client.act(in_session("s", Some(step), scene(2, 3, step))).await.unwrap();
    }
    assert_eq!(refused(client.act(in_session("s", Some(7), scene(2, 3, 0))).await).0, Code::FailedPrecondition);
    assert_eq!(refused(client.act(in_session("nobody", None, scene(2, 3, 0))).await).0, Code::NotFound);
    let act = |text: &str| calls(text, POLICIES, "Act", "unary");
    let handled = [("OK", 3.0), ("FailedPrecondition", 1.0), ("NotFound", 1.0)];
    // A call is counted after its last byte, which the client may have read before.
    let ended = async |seen: &dyn Fn(&str) -> Calls, expected: Calls| {
        with_timeout(async {
            loop {
                let now = seen(&binary.metrics().await);
                if now == expected {
                    return;
                }
                let early = now.timed < expected.timed || now.received < expected.received || now.sent < expected.sent;
                assert!(early, "{now:?}, not {expected:?}");
                tokio::task::yield_now().await;
            }
        })
        .await;
    };
    ended(&act, counted(5.0, &handled, 5.0, 3.0)).await;
    assert_eq!(binary.sample("qedgix_inference_count_total{policy=\"sweep\"}").await, 3.0);
    assert_eq!(binary.sample("qedgix_inference_exec_count_total{policy=\"sweep\"}").await, 3.0);
    assert_eq!(binary.sample("qedgix_inference_success_total{policy=\"sweep\"}").await, 3.0);
    assert_eq!(binary.sample("qedgix_inference_failure_total{policy=\"sweep\"}").await, 0.0);
    assert_eq!(binary.sample("qedgix_act_compute_seconds_count").await, 3.0);

    // A bidirectional stream: started at once, handled after its last message.
    let stream = |text: &str| calls(text, POLICIES, "ActStream", "bidi_stream");
    let (send, requests) = tokio::sync::mpsc::unbounded_channel();
    let requests = tokio_stream::wrappers::UnboundedReceiverStream::new(requests);
    let mut answers = client.act_stream(requests).await.unwrap().into_inner();
    for step in 3..6 {
        send.send(in_session("s", Some(step), scene(2, 3, step))).unwrap();
        assert!(matches!(answers.message().await.unwrap().unwrap().result, Some(v1::act_result::Result::Response(_))));
    }
    assert_eq!(stream(&binary.metrics().await), counted(1.0, &[], 3.0, 3.0));
    drop(send);
    assert!(answers.message().await.unwrap().is_none());
    ended(&stream, counted(1.0, &[("OK", 1.0)], 3.0, 3.0)).await;

    // A stream whose client disconnects.
    let (mut questions, answer) = raw_stream(&binary, "/qedgix.v1.PolicyService/ActStream").await;
    questions.send_data(framed(&in_session("s", None, scene(2, 3, 6))), false).unwrap();
    let mut answers = with_timeout(answer).await.unwrap().into_body();
    with_timeout(answers.data()).await.unwrap().unwrap();
    questions.send_reset(h2::Reason::CANCEL);
    ended(&stream, counted(2.0, &[("OK", 1.0), ("Canceled", 1.0)], 4.0, 4.0)).await;

    // A stream that fails with a status in its trailers.
    let mut garbled = tonic::client::Grpc::new(binary.channel().await);
    garbled.ready().await.unwrap();
    let pieces = futures::stream::iter([bytes::Bytes::from_static(b"\xff\xff\xff\xff")]);
    let path = "/qedgix.v1.PolicyService/ActStream".parse().unwrap();
    let answers = garbled.streaming(tonic::Request::new(pieces), path, super::super::limits::Raw).await.unwrap();
    let status = answers.into_inner().next().await.unwrap().unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    assert_eq!(status.metadata().get("qedgix-code").unwrap(), "invalid_argument");
    let handled = [("OK", 1.0), ("Canceled", 1.0), ("InvalidArgument", 1.0)];
    ended(&stream, counted(3.0, &handled, 5.0, 4.0)).await;

    // Server streams, and unknown methods.
    let mut health = HealthClient::new(binary.channel().await);
    let mut states = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    states.message().await.unwrap().unwrap();
    let watch = |text: &str| calls(text, "grpc.health.v1.Health", "Watch", "server_stream");
    assert_eq!(watch(&binary.metrics().await), counted(1.0, &[], 1.0, 1.0));
    drop(states);
    ended(&watch, counted(1.0, &[("Canceled", 1.0)], 1.0, 1.0)).await;
    for path in ["/qedgix.v1.PolicyService/Fly", "/made.up.Service1/Act", "/made.up.Service2/Act"] {
        garbled.ready().await.unwrap();
        let nothing = tonic::Request::new(bytes::Bytes::new());
        assert_eq!(
            refused(garbled.unary(nothing, path.parse().unwrap(), super::super::limits::Raw).await).0,
            Code::Unimplemented
        );
    }
    ended(&|text: &str| calls(text, "unknown", "unknown", "unary"), counted(3.0, &[("Unimplemented", 3.0)], 3.0, 0.0)).await;
    let text = binary.metrics().await;
    assert!(!text.contains("made.up") && !text.contains("Fly"), "paths of callers are no labels");
}

#[tokio::test]
async fn rest_is_counted_by_route() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &[]).await;
    let http = reqwest::Client::new();
    for path in ["/v1/policies/sweep:1", "/v1/policies/greedy-global:1", "/v1/policies/nobody", "/no/such/thing", "/another"] {
        http.get(format!("{}{path}", binary.http)).send().await.unwrap();
    }
    http.delete(format!("{}/v1/policies", binary.http)).send().await.unwrap();
    let brew = reqwest::Method::from_bytes(b"BREW").unwrap();
    http.request(brew, format!("{}/v1/policies", binary.http)).send().await.unwrap();
    let count = async |method: &str, route: &str, status: u16| {
        let labels = format!("{{method=\"{method}\",route=\"{route}\",status=\"{status}\"}}");
        let requests = binary.sample(&format!("http_requests_total{labels}")).await;
        assert_eq!(binary.sample(&format!("http_request_duration_seconds_count{labels}")).await, requests);
        requests
    };
    assert_eq!(count("GET", "/v1/policies/{policy}", 200).await, 2.0);
    assert_eq!(count("GET", "/v1/policies/{policy}", 404).await, 1.0);
    assert_eq!(count("GET", "unknown", 404).await, 2.0);
    assert_eq!(count("other", "/v1/policies", 405).await, 2.0);
    let text = binary.metrics().await;
    assert!(
        !text.contains("BREW") && !text.contains("/no/such") && !text.contains("nobody"),
        "input of callers does not become a label"
    );
}

#[test]
#[should_panic(expected = "of no family")]
fn samples_without_a_family_fail_the_parser() {
    parse("# HELP a_total Of a test.\n# TYPE a_total counter\na_total 1\nb_total 1\n");
}

#[test]
#[should_panic(expected = "counters end in _total")]
fn counters_without_total_fail_the_check() {
    check(&parse("# HELP fleets Of a test, counted.\n# TYPE fleets counter\nfleets 1\n"));
}
