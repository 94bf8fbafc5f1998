//! The output of the workers of a job: what is kept, and what arrives.

use std::sync::Arc;

use futures::{Stream, TryStreamExt};
use tokio::sync::{OwnedSemaphorePermit, watch};

use super::get;
use crate::jobs::LogTail;
use crate::service::keys::Caller;
use crate::service::{App, Error};
use crate::store::{Attempt, Job};

/// The newest attempts of a job with the last output of their workers, oldest first.
///
/// # Errors
/// [`Error::NotFound`].
pub async fn logs(app: &App, caller: &Caller, id: &str) -> Result<Vec<Attempt>, Error> {
    let job = get(app, caller, id).await?;
    let mut attempts = app.store.attempts(job.id).await?;
    for attempt in &mut attempts {
        if let Some(log) = app.scheduler.live_log(job.row_id, attempt.number) {
            attempt.log = log.text();
        }
    }
    Ok(attempts)
}

/// Lines of the output of one attempt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLines {
    /// Number of the attempt.
    pub attempt: u32,
    /// The lines, each with its end. The last line of an attempt may have none.
    pub text: String,
}

/// Follows the output of a job: that of its newest attempt so far, then what arrives, also of later attempts, until the job has
/// ended. A caller that reads too slowly misses lines.
///
/// # Errors
/// [`Error::NotFound`], [`Error::Busy`] when too many watches are open, [`Error::Draining`].
pub async fn follow_logs(
    app: &Arc<App>,
    caller: &Caller,
    id: &str,
) -> Result<impl Stream<Item = Result<LogLines, Error>> + Send + use<>, Error> {
    let permit = app.watchers.acquire(app)?;
    let job = get(app, caller, id).await?;
    let follower = Follower {
        changes: app.store.changes(job.row_id),
        app: Arc::clone(app),
        caller: caller.clone(),
        id: id.to_owned(),
        attempt: job.attempts.max(1),
        sent: 0,
        output: None,
        _permit: permit,
    };
    let lines = futures::stream::try_unfold(follower, |mut follower| async {
        let lines = follower.next().await?;
        Ok::<_, Error>(lines.map(|lines| (lines, follower)))
    });
    Ok(lines.try_filter(|lines| std::future::ready(!lines.text.is_empty())))
}

struct Follower {
    app: Arc<App>,
    caller: Caller,
    id: String,
    /// The attempt that is followed; it may not have begun.
    attempt: u32,
    /// Bytes of its output that were sent or that are no longer kept.
    sent: u64,
    /// Its output, while it runs and afterwards.
    output: Option<(LogTail, watch::Receiver<u64>)>,
    changes: watch::Receiver<()>,
    _permit: OwnedSemaphorePermit,
}

impl Follower {
    /// Waits for the next lines; they may be empty. `None`: the job has ended.
    async fn next(&mut self) -> Result<Option<LogLines>, Error> {
        loop {
            self.app.admit()?;
            // Marked before reading, so that a later change notifies again.
            self.changes.borrow_and_update();
            let job = get(&self.app, &self.caller, &self.id).await?;
            if self.output.is_none() {
                let log = self.app.scheduler.live_log(job.row_id, self.attempt);
                self.output = log.map(|log| (log.clone(), log.subscribe()));
            }
            let over = job.state.ended() || job.attempts > self.attempt;
            // What is left of an attempt includes its last line, even if that has no end.
            if let Some(text) = self.read(&job, over).await? {
                return Ok(Some(LogLines { attempt: self.attempt, text }));
            }
            if job.attempts > self.attempt {
                (self.attempt, self.sent, self.output) = (self.attempt + 1, 0, None);
                continue;
            }
            if job.state.ended() {
                return Ok(None);
            }
            let output = async {
                match &mut self.output {
                    Some((_, total)) => total.changed().await.map_err(Error::internal),
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                changed = self.changes.changed() => changed.map_err(Error::internal)?,
                changed = output => changed?,
                () = self.app.draining.wait() => {}
            }
        }
    }

    /// The output that was not sent; `None`: there is none.
    async fn read(&mut self, job: &Job, over: bool) -> Result<Option<String>, Error> {
        let (text, total) = if let Some((log, total)) = &mut self.output {
            total.borrow_and_update();
            log.text_after(self.sent, over)
        } else {
            // The worker has ended, or it belongs to an earlier run of the server.
            let attempts = self.app.store.attempts(job.id).await?;
            let log = attempts.into_iter().find(|attempt| attempt.number == self.attempt && attempt.ended_at.is_some());
            let text = log.map(|attempt| attempt.log).unwrap_or_default();
            let total = text.len() as u64;
            (if self.sent == 0 { text } else { String::new() }, total)
        };
        self.sent = self.sent.max(total);
        Ok(Some(text).filter(|text| !text.is_empty()))
    }
}
