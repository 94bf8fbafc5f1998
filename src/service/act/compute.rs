//! Runs the policy, for every location of the memory.

use std::time::Instant;

use tracing::level_filters::LevelFilter;

use crate::service::keys::Caller;
use crate::service::{App, Error};
use crate::serving::{Owner, Task, TaskOutput};

/// Decoding that costs more is done by the engine, not on the threads that serve connections: 0.2 ms.
const MAX_INLINE_DECODING: usize = 2048;

/// Estimated cost of decoding a request with this many nodes and detections, in the unit of the engine.
pub fn decoding_cost(nodes: usize, detections: usize) -> usize {
    8 * nodes + 3 * detections
}

/// Decodes a request of `caller`. `cost`: see [`decoding_cost`].
///
/// # Errors
/// [`Error::Busy`] and [`Error::Deadline`], if the engine decodes and its queue is too long.
pub async fn decode<T: Send + 'static>(
    app: &App,
    caller: &Caller,
    cost: usize,
    deadline: Option<Instant>,
    decode: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Error> {
    if cost <= MAX_INLINE_DECODING {
        return Ok(decode());
    }
    Ok(app.engine.call(caller.owner(), cost, deadline, decode).await?)
}

/// Runs the policy of `task`.
pub(super) async fn run(app: &App, owner: &Owner, task: Task, deadline: Option<Instant>) -> Result<TaskOutput, Error> {
    record_in_span("policy", &task.policy().reference);
    Ok(app.engine.run(owner, task, deadline).await?)
}

/// Adds a field to the span of the request, if spans are enabled.
pub(super) fn record_in_span(field: &'static str, value: &dyn std::fmt::Display) {
    if LevelFilter::current() >= LevelFilter::DEBUG {
        tracing::Span::current().record(field, tracing::field::display(value));
    }
}
