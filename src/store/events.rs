//! What happens to a job, in the order in which it was committed: changes of state and reported metrics share one row of
//! numbers per job. A number is never given twice, so whoever has seen the events up to one goes on behind it, also after a
//! restart.

use sqlx::FromRow;
use tokio::sync::watch;

use super::{JobState, MetricRow, Result, Store, timestamp};
use jiff::Timestamp;

/// Something that happened to a job.
#[derive(Clone, Debug, PartialEq)]
pub struct JobEvent {
    /// Its number: later is larger.
    pub id: u64,
    /// What it was.
    pub what: Happened,
}

/// What happened.
#[derive(Clone, Debug, PartialEq)]
pub enum Happened {
    /// The job came into another state.
    State {
        /// The new one.
        state: JobState,
        /// The newest attempt at that time; 0: none.
        attempt: u32,
        /// Why.
        reason: Option<String>,
        /// When.
        at: Timestamp,
    },
    /// Metrics were reported together. Those whose values were reported again with other values are with their last report.
    Metrics(Vec<MetricRow>),
}

#[derive(FromRow)]
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

/// Rows of one page, unless a single event has more.
const PAGE: i64 = 1000;

/// Bells of changes. Jobs that share one wake each other's listeners, who look and see nothing.
const BELLS: usize = 64;

/// Rung whenever something has happened to a job.
#[derive(Debug)]
pub(super) struct Bells([watch::Sender<()>; BELLS]);

impl Bells {
    pub(super) fn new() -> Self {
        Self(std::array::from_fn(|_| watch::Sender::new(())))
    }

    fn of(&self, job: i64) -> &watch::Sender<()> {
        &self.0[job as usize % BELLS]
    }
}

impl Store {
    /// Says that something was committed about job number `job`.
    pub(super) fn ring(&self, job: i64) {
        self.bells.of(job).send_replace(());
    }

    /// Changes whenever something has been committed about job number `job`, and now and then besides.
    pub fn changes(&self, job: i64) -> watch::Receiver<()> {
        self.bells.of(job).subscribe()
    }

    /// What happened to job number `job` behind event `after`, oldest first: a page of it, every event whole.
    ///
    /// # Errors
    /// The database.
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
            let mut events = gather(rows)?;
            // The last event of a full page may have more rows.
            if !full || events.pop().is_some_and(|_| !events.is_empty()) {
                return Ok(events);
            }
            limit *= 8;
        }
    }
}

fn gather(rows: Vec<Row>) -> Result<Vec<JobEvent>> {
    let mut events: Vec<JobEvent> = Vec::new();
    for Row { seq, at, state, attempt, reason, name, step, value } in rows {
        let (id, at) = (seq as u64, timestamp(at)?);
        if let Some(state) = state {
            let what = Happened::State { state: JobState::read(&state)?, attempt: attempt as u32, reason, at };
            events.push(JobEvent { id, what });
            continue;
        }
        let row = MetricRow { name, step: step as u64, value, at };
        match events.last_mut() {
            Some(JobEvent { id: last, what: Happened::Metrics(rows) }) if *last == id => rows.push(row),
            _ => events.push(JobEvent { id, what: Happened::Metrics(vec![row]) }),
        }
    }
    Ok(events)
}
