//! Trace export by OTLP over gRPC.
//!
//! A thread of the OpenTelemetry SDK sends finished spans in batches from a bounded queue. When the collector is unreachable
//! and the queue is full, spans are dropped; requests never wait. The standard environment variables apply
//! (`OTEL_TRACES_SAMPLER`, `OTEL_BSP_*`,
//! `OTEL_SERVICE_NAME`).

use std::time::Duration;

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing::Subscriber;
use tracing_subscriber::Layer;
use tracing_subscriber::registry::LookupSpan;

/// The address of the collector is invalid.
#[derive(Debug, thiserror::Error)]
#[error(
    "--otlp-endpoint: {endpoint:?} is not valid{reason}; expected the gRPC address of an OTLP collector, such as http://127.0.0.1:4317"
)]
pub struct InvalidEndpoint {
    endpoint: String,
    reason: String,
}

/// A running trace exporter.
#[derive(Clone, Debug)]
pub struct TraceExporter(SdkTracerProvider);

impl TraceExporter {
    /// Starts the export to the collector at `endpoint` (`http://HOST:PORT`) and makes request spans children of the caller's W3C
    /// `traceparent`. Must be called inside the tokio runtime that runs the server.
    ///
    /// # Errors
    /// [`InvalidEndpoint`] when `endpoint` is not such an address.
    pub fn start(endpoint: &str) -> Result<Self, InvalidEndpoint> {
        let invalid = |reason: String| InvalidEndpoint { endpoint: endpoint.to_owned(), reason };
        let uri: axum::http::Uri = endpoint.parse().map_err(|e| invalid(format!(" ({e})")))?;
        if uri.scheme_str() != Some("http") || uri.host().is_none_or(str::is_empty) {
            return Err(invalid(String::new()));
        }
        let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).with_timeout(Duration::from_secs(5));
        let exporter = exporter.build().map_err(|e| invalid(format!(" ({e})")))?;
        let mut resource = Resource::builder();
        if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
            resource = resource.with_service_name("qedgix");
        }
        let resource =
            resource.with_attribute(opentelemetry::KeyValue::new("service.version", env!("CARGO_PKG_VERSION"))).build();
        opentelemetry::global::set_text_map_propagator(TraceContextPropagator::new());
        Ok(Self(SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build()))
    }

    /// The layer that sends spans to the exporter.
    pub(super) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> impl Layer<S> + use<S> {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("qedgix"))
            .with_location(false)
            .with_threads(false)
            .with_tracked_inactivity(false)
    }

    /// Sends the remaining spans for at most `timeout` and ends the export.
    pub async fn shutdown(self, timeout: Duration) {
        // The SDK blocks, and logs when spans are lost.
        let ended = tokio::task::spawn_blocking(move || self.0.shutdown_with_timeout(timeout));
        let _ = tokio::time::timeout(timeout, ended).await;
    }
}
