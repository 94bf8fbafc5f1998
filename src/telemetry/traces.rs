//! Traces, exported by OTLP over gRPC.
//!
//! A thread of the SDK sends finished spans in batches from a bounded queue. A collector that is away costs spans, never
//! time: what does not fit into the queue is dropped. Sampling, batch sizes and the service's name follow the environment
//! variables that OpenTelemetry defines (`OTEL_TRACES_SAMPLER`, `OTEL_BSP_*`, `OTEL_SERVICE_NAME`).

use std::time::Duration;

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing::Subscriber;
use tracing_subscriber::Layer;
use tracing_subscriber::registry::LookupSpan;

/// An address that no collector can have.
#[derive(Debug, thiserror::Error)]
#[error(
    "--otlp-endpoint: {endpoint:?} cannot be used{reason}; expected the address of an OTLP collector's gRPC, as http://127.0.0.1:4317"
)]
pub struct BadEndpoint {
    endpoint: String,
    reason: String,
}

/// The exporter of traces.
#[derive(Clone, Debug)]
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// Exports to the collector at `endpoint`, `http://HOST:PORT`, whenever it can be reached. Trace ids of callers
    /// (W3C `traceparent`) are followed from now on. To be called inside a runtime, which is to last.
    ///
    /// # Errors
    /// An address that is none.
    pub fn start(endpoint: &str) -> Result<Self, BadEndpoint> {
        let bad = |reason: String| BadEndpoint { endpoint: endpoint.to_owned(), reason };
        let uri: axum::http::Uri = endpoint.parse().map_err(|e| bad(format!(" ({e})")))?;
        if uri.scheme_str() != Some("http") || uri.host().is_none_or(str::is_empty) {
            return Err(bad(String::new()));
        }
        let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).with_timeout(Duration::from_secs(5));
        let exporter = exporter.build().map_err(|e| bad(format!(" ({e})")))?;
        let mut resource = Resource::builder();
        if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
            resource = resource.with_service_name("qedgix");
        }
        let resource =
            resource.with_attribute(opentelemetry::KeyValue::new("service.version", env!("CARGO_PKG_VERSION"))).build();
        opentelemetry::global::set_text_map_propagator(TraceContextPropagator::new());
        Ok(Self(SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build()))
    }

    /// What turns spans of this program into spans of a trace.
    pub(super) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> impl Layer<S> + use<S> {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("qedgix"))
            .with_location(false)
            .with_threads(false)
            .with_tracked_inactivity(false)
    }

    /// Sends what is left, for at most `patience`, and ends the export.
    pub async fn end(self, patience: Duration) {
        // It blocks. What could not be sent until then is lost, and that is said by the SDK.
        let ended = tokio::task::spawn_blocking(move || self.0.shutdown_with_timeout(patience));
        let _ = tokio::time::timeout(patience, ended).await;
    }
}
