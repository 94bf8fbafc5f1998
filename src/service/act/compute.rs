//! Converts the input of a fleet and runs the policy, for every location of the memory.

use std::sync::Arc;
use std::time::Instant;

use tracing::level_filters::LevelFilter;

use crate::policy::FleetGraph;
use crate::service::{App, Error};
use crate::serving::{LoadedPolicy, SceneOrGraph, Task, TaskOutput};

/// Inputs with at least this many nodes are converted on a blocking thread, not on the threads that serve connections.
pub const OFFLOAD_NODES: usize = 256;

/// Converts the scene or graph of `uavs` UAVs and `users` users to the input of `policy`.
pub(super) async fn convert(
    content: SceneOrGraph,
    (uavs, users): (usize, usize),
    policy: &Arc<LoadedPolicy>,
) -> Result<FleetGraph, Error> {
    if uavs + users < OFFLOAD_NODES {
        return Ok(content.into_fleet_graph((uavs, users), &*policy.implementation)?);
    }
    let policy = policy.clone();
    let converted = tokio::task::spawn_blocking(move || content.into_fleet_graph((uavs, users), &*policy.implementation));
    Ok(converted.await.map_err(Error::internal)??)
}

/// Runs the policy of `task`.
pub(super) async fn run(app: &App, task: Task, deadline: Option<Instant>) -> Result<TaskOutput, Error> {
    record_in_span("policy", &task.policy().reference);
    Ok(app.engine.run(task, deadline).await?)
}

/// Adds a field to the span of the request, if spans are enabled.
pub(super) fn record_in_span(field: &'static str, value: &dyn std::fmt::Display) {
    if LevelFilter::current() >= LevelFilter::DEBUG {
        tracing::Span::current().record(field, tracing::field::display(value));
    }
}
