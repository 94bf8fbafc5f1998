//! Logs and metrics of the process. Both are set up once, however many servers it holds.

use std::io::IsTerminal;
use std::sync::OnceLock;

use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use tracing_subscriber::EnvFilter;

/// Upper bounds of the buckets of times, in seconds: from a small fleet's forward pass to a client's patience.
const SECONDS: [f64; 16] = [1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 0.1, 0.25, 1.0, 5.0, 30.0];

/// The recorder of metrics, as `/metrics` renders it.
///
/// # Panics
/// When another recorder was installed by the program that embeds this library.
pub fn metrics() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    let install = || {
        let handle = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &SECONDS)
            .and_then(PrometheusBuilder::install_recorder)
            .expect("the buckets are not empty, and this is the program's only recorder");
        metrics::describe_counter!("qedgix_requests_total", "Requests answered, by transport, method and code.");
        metrics::describe_histogram!("qedgix_request_seconds", "Time to answer a request.");
        metrics::describe_histogram!("qedgix_act_queue_seconds", "Time a fleet waited for the engine.");
        metrics::describe_histogram!("qedgix_act_compute_seconds", "Time the engine computed for a fleet.");
        metrics::describe_gauge!("qedgix_sessions", "Open sessions.");
        metrics::describe_gauge!("qedgix_policy_versions", "Policy versions that can be asked.");
        handle
    };
    HANDLE.get_or_init(install).clone()
}

/// Sends logs to standard error, filtered by `QEDGIX_LOG` (`info` when absent). Called twice, the first call counts.
pub fn logs(json: bool) {
    let filter = EnvFilter::try_from_env("QEDGIX_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let set = if json { builder.json().try_init() } else { builder.with_ansi(std::io::stderr().is_terminal()).try_init() };
    // A program that embeds this library may have set up its own.
    let _ = set;
}
