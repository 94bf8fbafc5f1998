//! Events of jobs as messages of `WatchJob` and as server-sent events. Both tell the same.

use jiff::Timestamp;
use serde::Serialize;

use super::jobs::MetricView;
use super::response::timestamp;
use crate::store::{JobEvent, JobEventKind, JobState};
use crate::wire::v1;

/// The data of an event as REST sends it.
#[derive(Debug, Serialize)]
#[serde(untagged)]
pub enum EventView {
    /// Of an event `state`.
    State {
        /// The new state.
        state: JobState,
        /// The newest attempt at that time; 0: none.
        attempt: u32,
        /// Why.
        reason: Option<String>,
        /// When.
        at: Timestamp,
    },
    /// Of an event `metrics`.
    Metrics {
        /// What was reported together.
        metrics: Vec<MetricView>,
    },
}

impl EventView {
    /// The event's name.
    pub fn name(&self) -> &'static str {
        match self {
            Self::State { .. } => "state",
            Self::Metrics { .. } => "metrics",
        }
    }
}

impl From<JobEventKind> for EventView {
    fn from(happened: JobEventKind) -> Self {
        match happened {
            JobEventKind::State { state, attempt, reason, at } => Self::State { state, attempt, reason, at },
            JobEventKind::Metrics(rows) => Self::Metrics { metrics: rows.into_iter().map(Into::into).collect() },
        }
    }
}

impl From<JobEvent> for v1::JobEvent {
    fn from(event: JobEvent) -> Self {
        use v1::job_event::What;
        let what = match event.kind {
            JobEventKind::State { state, attempt, reason, at } => What::State(v1::JobStateChange {
                state: v1::JobState::from(state).into(),
                attempt,
                reason: reason.unwrap_or_default(),
                at: Some(timestamp(at)),
            }),
            JobEventKind::Metrics(rows) => What::Metrics(v1::JobMetrics { rows: rows.into_iter().map(Into::into).collect() }),
        };
        Self { id: event.id, what: Some(what) }
    }
}
