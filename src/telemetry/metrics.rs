//! Metrics: the recorder that `/metrics` renders, what each family means, and figures of the process.

use std::sync::{LazyLock, OnceLock};

use metrics::{describe_counter, describe_gauge, describe_histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

/// Upper bounds of the buckets of times, in seconds: from a small fleet's forward pass to a client's patience.
const SECONDS: [f64; 16] = [1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 0.1, 0.25, 1.0, 5.0, 30.0];
/// Upper bounds of the buckets of batches, in fleets.
const FLEETS: [f64; 9] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];

/// The recorder of metrics, as `/metrics` renders it.
///
/// # Panics
/// When another recorder was installed by the program that embeds this library.
pub fn metrics() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    let install = || {
        let handle = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &SECONDS)
            .and_then(|builder| builder.set_buckets_for_metric(Matcher::Suffix("_batch_size".into()), &FLEETS))
            .and_then(PrometheusBuilder::install_recorder)
            .expect("the buckets are not empty, and this is the program's only recorder");
        describe();
        metrics::gauge!("qedgix_build_info", "version" => env!("CARGO_PKG_VERSION")).set(1.0);
        handle
    };
    HANDLE.get_or_init(install).clone()
}

fn describe() {
    describe_counter!("grpc_server_started_total", "gRPC calls begun.");
    describe_counter!("grpc_server_handled_total", "gRPC calls ended, by status; a stream ends with its last message.");
    describe_histogram!("grpc_server_handling_seconds", "Time from the head of a gRPC call to the end of its answer.");
    describe_counter!("grpc_server_msg_received_total", "Messages received in gRPC calls.");
    describe_counter!("grpc_server_msg_sent_total", "Messages sent in gRPC calls.");
    describe_counter!("http_requests_total", "REST requests answered.");
    describe_histogram!("http_request_duration_seconds", "Time to the head of a REST answer.");
    describe_histogram!("qedgix_act_queue_seconds", "Time a fleet waited for the engine.");
    describe_histogram!("qedgix_act_compute_seconds", "Time the engine computed for a fleet.");
    describe_histogram!("qedgix_act_batch_size", "Fleets computed in one forward pass.");
    describe_counter!("qedgix_inference_count_total", "Fleets computed, by policy.");
    describe_counter!("qedgix_inference_exec_count_total", "Forward passes, by policy; one computes a batch of fleets.");
    describe_counter!("qedgix_inference_success_total", "Fleets that asked the engine and were answered, by policy.");
    describe_counter!("qedgix_inference_failure_total", "Fleets that asked the engine and were not answered, by policy.");
    describe_gauge!("qedgix_engine_queue_depth", "Fleets that wait for the engine.");
    describe_gauge!("qedgix_sessions", "Open sessions.");
    describe_gauge!("qedgix_environments", "Hosted environments.");
    describe_gauge!("qedgix_policy_versions", "Policy versions that can be asked.");
    describe_gauge!("qedgix_jobs", "Jobs, by state.");
    describe_counter!("qedgix_jobs_submitted_total", "Jobs submitted since the process began.");
    describe_gauge!("qedgix_job_watchers", "Streams of a job's events that are open.");
    describe_gauge!("qedgix_training_threads_busy", "Threads that running jobs use.");
    describe_gauge!("qedgix_training_threads", "Threads that running jobs may use together.");
    describe_gauge!("qedgix_build_info", "1, with the version of the program.");
}

/// All metrics as Prometheus text, those of the process (memory, time, files, threads) read now.
pub fn render() -> String {
    static PROCESS: LazyLock<metrics_process::Collector> = LazyLock::new(|| {
        let collector = metrics_process::Collector::default();
        collector.describe();
        collector
    });
    let recorder = metrics();
    PROCESS.collect();
    recorder.render()
}
