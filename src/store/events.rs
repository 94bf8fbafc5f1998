//! The event log of each job: changes of state and reported metrics in the order of their commits. Event ids increase per
//! job and are never reused, so a reader can continue after any event, also after a restart.

use tokio::sync::watch;

use super::{JobState, MetricRow, Result, Store, timestamp};
use jiff::Timestamp;

/// An event of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct JobEvent {
    /// Id; later events have larger ids.
    pub id: u64,
    /// What happened.
    pub kind: JobEventKind,
}

/// The kinds of events.
#[derive(Clone, Debug, PartialEq)]
pub enum JobEventKind {
    /// The state of the job changed.
    State {
        /// The new state.
        state: JobState,
        /// The newest attempt at that time; 0 before the first.
        attempt: u32,
        /// Why the state changed.
        reason: Option<String>,
        /// When the state changed.
        at: Timestamp,
    },
    /// Metrics of one report. A metric that is reported again with another value moves to the event of the later report.
    Metrics(Vec<MetricRow>),
}

from_row! {
    struct Row {
        seq: i64,
        at: i64,
        state: Option<String>,
        attempt: i64,
        reason: Option<String>,
        name: String,
        step: i64,
        value: Option<f64>,
    }
}

/// Rows per page, unless a single event has more.
const PAGE: i64 = 1000;

/// Number of channels. Jobs that share a channel wake each other's listeners, which then find no event.
const CHANNELS: usize = 64;

/// Notifies listeners of new events, in one channel per row id modulo [`CHANNELS`].
#[derive(Debug)]
pub(super) struct Notifier([watch::Sender<()>; CHANNELS]);

impl Notifier {
    pub(super) fn new() -> Self {
        Self(std::array::from_fn(|_| watch::Sender::new(())))
    }

    fn channel(&self, job: i64) -> &watch::Sender<()> {
        &self.0[job as usize % CHANNELS]
    }
}

impl Store {
    /// Notifies listeners that an event of the job with row id `job` was committed.
    pub(super) fn notify(&self, job: i64) {
        self.notifier.channel(job).send_replace(());
    }

    /// Notifies all listeners: events of several jobs were committed.
    pub(super) fn notify_all(&self) {
        self.notifier.0.iter().for_each(|channel| channel.send_replace(()));
    }

    /// A receiver that changes whenever an event of the job with row id `job` was committed, and sometimes without one.
    pub fn changes(&self, job: i64) -> watch::Receiver<()> {
        self.notifier.channel(job).subscribe()
    }

    /// A receiver that changes whenever jobs may have ended, and sometimes when none has.
    pub fn any_changes(&self) -> watch::Receiver<()> {
        self.changes(0)
    }

    /// A page of the events of the job with row id `job` after event `after`, oldest first. Every event is complete.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn events(&self, job: i64, after: u64) -> Result<Vec<JobEvent>> {
        let sql = "SELECT seq, at, state, attempt, reason, '' AS name, 0 AS step, NULL AS value
                     FROM events WHERE job = ?1 AND seq > ?2
                   UNION ALL
                   SELECT seq, at, NULL, 0, NULL, name, step, value FROM metrics WHERE job = ?1 AND seq > ?2
                   ORDER BY 1 LIMIT ?3";
        let mut limit = PAGE;
        loop {
            let rows: Vec<Row> = sqlx::query_as(sql).bind(job).bind(after as i64).bind(limit).fetch_all(&self.read).await?;
            let full = rows.len() as i64 == limit;
            let mut events = group_rows(rows)?;
            if !full {
                return Ok(events);
            }
            // The last event of a full page may have more rows, so it belongs to the next page.
            events.pop();
            if !events.is_empty() {
                return Ok(events);
            }
            // One event fills the whole page.
            limit *= 8;
        }
    }
}

fn group_rows(rows: Vec<Row>) -> Result<Vec<JobEvent>> {
    let mut events: Vec<JobEvent> = Vec::new();
    for Row { seq, at, state, attempt, reason, name, step, value } in rows {
        let (id, at) = (seq as u64, timestamp(at)?);
        if let Some(state) = state {
            let kind = JobEventKind::State { state: JobState::from_column(&state)?, attempt: attempt as u32, reason, at };
            events.push(JobEvent { id, kind });
            continue;
        }
        let row = MetricRow { name, step: step as u64, value, at };
        match events.last_mut() {
            Some(JobEvent { id: last, kind: JobEventKind::Metrics(rows) }) if *last == id => rows.push(row),
            _ => events.push(JobEvent { id, kind: JobEventKind::Metrics(vec![row]) }),
        }
    }
    Ok(events)
}
