//! Prometheus metrics: the recorder, the description of each family, and process metrics.

use std::sync::{LazyLock, OnceLock};

use metrics::{describe_counter, describe_gauge, describe_histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

/// Bucket bounds of durations in seconds, from the forward pass of a small fleet to the timeout of a client.
const SECONDS: [f64; 16] = [1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 0.1, 0.25, 1.0, 5.0, 30.0];
/// Bucket bounds of batch sizes in fleets.
const FLEETS: [f64; 9] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];

/// Installs the recorder on the first call and returns its handle. Metrics that are created earlier are lost.
///
/// # Panics
/// Panics when a program that embeds this library has installed another recorder.
pub fn install_metrics() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    let install = || {
        let handle = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &SECONDS)
            .and_then(|builder| builder.set_buckets_for_metric(Matcher::Suffix("_batch_size".into()), &FLEETS))
            .and_then(PrometheusBuilder::install_recorder)
            .expect("the buckets are not empty, and no other recorder is installed");
        describe();
        metrics::gauge!("qedgix_build_info", "version" => env!("CARGO_PKG_VERSION")).set(1.0);
        handle
    };
    HANDLE.get_or_init(install).clone()
}

fn describe() {
    describe_counter!("grpc_server_started_total", "gRPC calls started.");
    describe_counter!("grpc_server_handled_total", "gRPC calls completed, by status. A stream completes with its last message.");
    describe_histogram!("grpc_server_handling_seconds", "Time from the header of a gRPC request to the end of its response.");
    describe_counter!("grpc_server_msg_received_total", "Messages received in gRPC calls.");
    describe_counter!("grpc_server_msg_sent_total", "Messages sent in gRPC calls.");
    describe_counter!("qedgix_jobs_deleted_total", "Ended jobs that the rules of retention deleted.");
    describe_counter!("qedgix_webhook_messages_total", "Tries to tell the receivers of webhooks, by result.");
    describe_gauge!("qedgix_replica_age_seconds", "Replica: time since its policies were last known to be those of the primary.");
    describe_gauge!("qedgix_replica_missing_versions", "Replica: versions of the primary that cannot be taken over.");
    describe_counter!("qedgix_replica_failures_total", "Replica: questions to the primary that failed.");
    describe_counter!("http_requests_total", "REST requests completed.");
    describe_histogram!("http_request_duration_seconds", "Time from a REST request to the header of its response.");
    describe_gauge!("qedgix_connections", "Open connections, including those of workers.");
    describe_counter!(
        "qedgix_connections_refused_total",
        "Connections closed at once because of --max-connections or --max-connections-per-peer."
    );
    describe_counter!("qedgix_connections_ended_total", "Connections that the server ended, by reason.");
    describe_histogram!("qedgix_act_queue_seconds", "Time a fleet waited in the queue of the engine.");
    describe_histogram!("qedgix_act_compute_seconds", "Time of the forward pass that computed a fleet.");
    describe_histogram!("qedgix_act_batch_size", "Fleets per forward pass.");
    describe_counter!("qedgix_inference_count_total", "Fleets computed, by policy.");
    describe_counter!(
        "qedgix_inference_exec_count_total",
        "Forward passes, by policy. One forward pass computes a batch of fleets."
    );
    describe_counter!("qedgix_inference_success_total", "Fleets answered by the engine, by policy.");
    describe_counter!("qedgix_inference_failure_total", "Fleets sent to the engine and not answered, by policy.");
    describe_gauge!("qedgix_engine_queue_depth", "Fleets in the queue of the engine.");
    describe_gauge!("qedgix_sessions", "Open sessions.");
    describe_gauge!("qedgix_session_memory_bytes", "Memory of all sessions together, in bytes.");
    describe_gauge!("qedgix_environments", "Hosted environments.");
    describe_gauge!("qedgix_policy_versions", "Policy versions.");
    describe_gauge!("qedgix_inflight_bytes", "Bytes of requests and responses that the server holds.");
    describe_gauge!("qedgix_policy_memory_bytes", "Memory of the policy versions that were read.");
    describe_counter!("qedgix_policy_loads_total", "Policy versions read into memory.");
    describe_gauge!("qedgix_jobs", "Jobs, by state.");
    describe_counter!("qedgix_jobs_submitted_total", "Jobs submitted since the process started.");
    describe_counter!(
        "qedgix_worker_start_failures_total",
        "Tries to start a worker that failed, because the host is in trouble."
    );
    describe_gauge!("qedgix_job_watchers", "Open streams of job events.");
    describe_gauge!("qedgix_training_threads_busy", "Threads used by running jobs.");
    describe_gauge!("qedgix_training_threads", "CPU budget: threads that all running jobs may use together.");
    describe_gauge!("qedgix_ready", "Whether the server is ready, as /readyz says: 1 or 0.");
    describe_gauge!("qedgix_database_writable", "Whether the database can be written: 1 or 0.");
    describe_gauge!("qedgix_tls_certificate_expiry_timestamp_seconds", "When the TLS certificate in use expires, as Unix time.");
    describe_counter!("qedgix_log_lines_dropped_total", "Log lines that were dropped because standard error was not read.");
    describe_gauge!("qedgix_build_info", "Always 1; the label holds the version.");
}

/// All metrics in Prometheus text format. Process metrics (memory, CPU time, files, threads) are read at this moment.
pub fn render_metrics() -> String {
    static PROCESS: LazyLock<metrics_process::Collector> = LazyLock::new(|| {
        let collector = metrics_process::Collector::default();
        collector.describe();
        collector
    });
    let recorder = install_metrics();
    PROCESS.collect();
    recorder.render()
}
