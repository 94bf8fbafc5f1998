//! Traces: the spans that a collector receives, and a collector that does not respond.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::{AnyValue, KeyValue, any_value};
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use tokio::net::TcpListener;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};

use super::super::binary::Binary;
use super::super::harness::*;
use super::fly;

/// A collector that keeps all received spans.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<ExportTraceServiceRequest>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(&self, request: Request<ExportTraceServiceRequest>) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.lock().unwrap().push(request.into_inner());
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    async fn start() -> (Self, String) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let collector = Self::default();
        let server = tonic::transport::Server::builder().add_service(TraceServiceServer::new(collector.clone()));
        tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
        (collector, address)
    }

    fn spans(&self) -> Vec<Span> {
        let requests = self.0.lock().unwrap();
        let resources = requests.iter().flat_map(|request| &request.resource_spans);
        resources.flat_map(|spans| &spans.scope_spans).flat_map(|spans| spans.spans.clone()).collect()
    }

    /// Attributes of the resource that sent the spans.
    fn resource(&self) -> BTreeMap<String, String> {
        let requests = self.0.lock().unwrap();
        attributes(&requests[0].resource_spans[0].resource.as_ref().unwrap().attributes)
    }
}

fn attributes(attributes: &[KeyValue]) -> BTreeMap<String, String> {
    let text = |value: &Option<AnyValue>| match value.as_ref().and_then(|value| value.value.clone()) {
        Some(any_value::Value::StringValue(text)) => text,
        other => format!("{other:?}"),
    };
    attributes.iter().map(|attribute| (attribute.key.clone(), text(&attribute.value))).collect()
}

fn hex(bytes: &[u8]) -> String {
    hex::encode(bytes)
}

#[tokio::test]
async fn spans_are_exported_with_the_trace_of_the_caller() {
    const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    const PARENT: &str = "00f067aa0ba902b7";
    let (collector, address) = Collector::start().await;
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--otlp-endpoint", &address]).await;
    fly(&binary, "flight-1", 0).await;
    let mut client = binary.policies().await;
    let traced = |message, flags: &str| {
        let mut request = Request::new(message);
        let parent = format!("00-{TRACE}-{PARENT}-{flags}");
        request.metadata_mut().insert("traceparent", parent.parse().unwrap());
        request.metadata_mut().insert("x-request-id", format!("traced-{flags}").parse().unwrap());
        request
    };
    client.act(traced(in_session("flight-1", Some(1), scene(2, 3, 1)), "01")).await.unwrap();
    client.act(traced(in_session("flight-1", Some(9), scene(2, 3, 1)), "01")).await.unwrap_err();
    // The caller decided not to sample this request.
    client.act(traced(in_session("flight-1", Some(2), scene(2, 3, 1)), "00")).await.unwrap();
    let rest = reqwest::Client::new().get(format!("{}/v1/policies/sweep", binary.http));
    let rest = rest.header("traceparent", format!("00-{TRACE}-{PARENT}-01")).send().await.unwrap();
    assert_eq!(rest.status(), 200);
    // The server sends the remaining spans at shutdown.
    binary.signal("TERM");
    let (code, lines) = binary.ended().await;
    assert_eq!(code, Some(0), "{lines:?}");

    let spans = collector.spans();
    let mut ours: Vec<&Span> = spans.iter().filter(|span| hex(&span.trace_id) == TRACE).collect();
    ours.sort_by_key(|span| span.start_time_unix_nano);
    let names: Vec<&str> = ours.iter().map(|span| span.name.as_str()).collect();
    assert_eq!(names, ["qedgix.v1.PolicyService/Act", "qedgix.v1.PolicyService/Act", "GET /v1/policies/{policy}"]);
    for span in &ours {
        assert_eq!(hex(&span.parent_span_id), PARENT);
        assert_eq!(span.kind(), SpanKind::Server);
        assert!(span.end_time_unix_nano >= span.start_time_unix_nano && span.events.is_empty());
    }
    let [flown, refused, shown] = [0, 1, 2].map(|i| attributes(&ours[i].attributes));
    for (name, value) in [("session", "flight-1"), ("policy", "sweep:1"), ("code", "OK"), ("request_id", "traced-01")] {
        assert_eq!(flown[name], value, "{flown:?}");
    }
    assert_eq!((refused["code"].as_str(), shown["code"].as_str()), ("FailedPrecondition", "200"));
    assert!(!spans.iter().any(|span| attributes(&span.attributes).get("request_id").is_some_and(|id| id == "traced-00")));
    // A request without a traceparent starts a trace.
    let opened = spans.iter().find(|span| span.name == "qedgix.v1.PolicyService/OpenSession").unwrap();
    assert!(hex(&opened.trace_id) != TRACE && opened.parent_span_id.is_empty());
    let resource = collector.resource();
    assert_eq!((resource["service.name"].as_str(), resource["service.version"].as_str()), ("qedgix", env!("CARGO_PKG_VERSION")));
}

#[tokio::test]
async fn an_unreachable_or_silent_collector_delays_no_request() {
    // A closed port, and a port that accepts connections and never responds.
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    for address in [closed, silent.local_addr().unwrap()] {
        let dir = tempfile::tempdir().unwrap();
        let flags = ["--otlp-endpoint", &format!("http://{address}"), "--drain-timeout", "100ms"];
        let binary = Binary::start(dir.path(), &flags).await;
        for step in 0..20 {
            assert_eq!(fly(&binary, "s", step).await.step, step);
        }
        binary.signal("TERM");
        let (code, lines) = binary.ended().await;
        assert_eq!(code, Some(0), "{lines:?}");
    }
}

#[tokio::test]
async fn invalid_collector_addresses_are_refused() {
    for wrong in ["127.0.0.1:4317", "https://127.0.0.1:4317", "http://", "/tmp/socket", ""] {
        let dir = tempfile::tempdir().unwrap();
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_qedgix"))
            .args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--otlp-endpoint", wrong, "--data-dir"])
            .arg(dir.path())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && text.contains("--otlp-endpoint") && text.contains("http://127.0.0.1:4317"), "{text}");
    }
}
