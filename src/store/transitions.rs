//! Changes of the state of a job, and what follows from them for the jobs that wait for it.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::webhooks::tell_end;
use super::{JobState, Result};

/// A change of state and its entry in the event log.
pub(super) struct Transition<'a> {
    pub(super) job: i64,
    pub(super) to: JobState,
    pub(super) attempt: u32,
    pub(super) reason: Option<&'a str>,
    pub(super) now: Timestamp,
}

/// Moves a job to another state and appends an event. Deletes the snapshot of a job that ends, unless it failed: a failed job can
/// be retried. A job that succeeds, or can no longer do so, changes the jobs that wait for it.
pub(super) async fn transition(db: &mut SqliteConnection, t: Transition<'_>) -> Result<()> {
    let now = t.now.as_millisecond();
    let ended = t.to.ended().then_some(now);
    let started = (t.to == JobState::Running).then_some(now);
    let state = t.to.as_str();
    let sql = "UPDATE jobs SET state = ?2, wanted = NULL, reason = ?3, not_before = NULL, ended_at = ?4, started_at = coalesce(started_at, ?5),
               seq = seq + 1 WHERE number = ?1 RETURNING seq, parent";
    let update = sqlx::query_as(sql).bind(t.job).bind(state).bind(t.reason).bind(ended).bind(started);
    let (seq, parent): (i64, Option<String>) = update.fetch_one(&mut *db).await?;
    let sql = "INSERT INTO events (job, at, state, attempt, reason, seq) VALUES (?, ?, ?, ?, ?, ?)";
    let insert = sqlx::query(sql).bind(t.job).bind(now).bind(state).bind(t.attempt).bind(t.reason).bind(seq);
    insert.execute(&mut *db).await?;
    if t.to.ended() {
        tell_end(db, t.job, state, t.now).await?;
    }
    if t.to.ended() && t.to != JobState::Failed {
        sqlx::query("DELETE FROM snapshots WHERE job = ?").bind(t.job).execute(&mut *db).await?;
        release_dependents(db, t.job, t.to == JobState::Succeeded, t.now).await?;
    }
    // The first event of a job of a sweep comes with the sweep itself.
    if let Some(parent) = parent.filter(|_| seq > 1) {
        follow_jobs(db, &parent, t.now).await?;
    }
    Ok(())
}

/// Moves a sweep to the state that follows from the states of its jobs.
async fn follow_jobs(db: &mut SqliteConnection, sweep: &str, now: Timestamp) -> Result<()> {
    let sql = "SELECT number, state FROM jobs WHERE id = ?";
    let found: Option<(i64, String)> = sqlx::query_as(sql).bind(sweep).fetch_optional(&mut *db).await?;
    // A sweep that is being deleted.
    let Some((number, state)) = found else { return Ok(()) };
    let sql = "SELECT state, count(*), sum(step) FROM jobs WHERE parent = ? GROUP BY state";
    let states: Vec<(String, i64, i64)> = sqlx::query_as(sql).bind(sweep).fetch_all(&mut *db).await?;
    let count = |state: JobState| states.iter().filter(|row| row.0 == state.as_str()).map(|row| row.1).sum::<i64>();
    let all: i64 = states.iter().map(|row| row.1).sum();
    let step = states.iter().fold(0_i64, |sum, row| sum.saturating_add(row.2));
    sqlx::query("UPDATE jobs SET step = ? WHERE number = ?").bind(step).bind(number).execute(&mut *db).await?;
    let failed = count(JobState::Failed);
    let to = if count(JobState::Queued) + count(JobState::Running) > 0 {
        JobState::Running
    } else if count(JobState::Paused) > 0 {
        JobState::Paused
    } else if failed > 0 {
        JobState::Failed
    } else if count(JobState::Cancelled) > 0 {
        JobState::Cancelled
    } else {
        JobState::Succeeded
    };
    if to.as_str() == state {
        return Ok(());
    }
    let reason = format!("{failed} of {all} jobs failed");
    let reason = Some(reason.as_str()).filter(|_| to == JobState::Failed);
    Box::pin(transition(db, Transition { job: number, to, attempt: 0, reason, now })).await
}

/// Counts the jobs that must succeed before `job` can start.
pub(super) async fn count_blockers(db: &mut SqliteConnection, job: i64) -> Result<()> {
    let sql = "UPDATE jobs SET blocked = (SELECT count(*) FROM job_dependencies d JOIN jobs n ON n.number = d.needs
                                          WHERE d.job = jobs.number AND n.state <> 'succeeded') WHERE number = ?";
    sqlx::query(sql).bind(job).execute(&mut *db).await?;
    Ok(())
}

/// Lets the jobs that wait for `job` start if it succeeded. If it never will, they are cancelled.
pub(super) async fn release_dependents(db: &mut SqliteConnection, job: i64, succeeded: bool, now: Timestamp) -> Result<()> {
    let sql = "SELECT j.number, j.attempts, j.state FROM job_dependencies d JOIN jobs j ON j.number = d.job WHERE d.needs = ?";
    let dependents: Vec<(i64, i64, String)> = sqlx::query_as(sql).bind(job).fetch_all(&mut *db).await?;
    for (dependent, attempts, state) in dependents {
        if succeeded {
            count_blockers(db, dependent).await?;
        } else if !JobState::from_column(&state)?.ended() {
            let reason = Some("a job that it comes after was cancelled or deleted");
            let cancel = Transition { job: dependent, to: JobState::Cancelled, attempt: attempts as u32, reason, now };
            Box::pin(transition(db, cancel)).await?;
        }
    }
    Ok(())
}
