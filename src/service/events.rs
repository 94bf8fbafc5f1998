//! Watching a job: its past and future events in the order of their commits, until the job has ended.
//!
//! A watch reads a page of events at a time, so a slow caller holds one page in memory. The number of open watches is
//! limited.

use std::sync::Arc;

use futures::{Stream, TryStreamExt};
use tokio::sync::{OwnedSemaphorePermit, watch};

use super::keys::Caller;
use super::progress::Progress;
use super::{App, Error, jobs};
use crate::invalid::in_range;
use crate::store::{Job, JobEvent, JobEventKind};

/// An event, and the progress of the job if it has metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct WatchedEvent {
    /// The event.
    pub event: JobEvent,
    /// The progress.
    pub progress: Option<Progress>,
}

/// A watch of a job.
pub struct Watch {
    app: Arc<App>,
    caller: Caller,
    id: String,
    job: i64,
    steps: u64,
    after: u64,
    ended: bool,
    changes: watch::Receiver<()>,
    _permit: OwnedSemaphorePermit,
}

/// Watches job `id` from the event after `after`; 0 is from the beginning.
///
/// # Errors
/// [`Error::NotFound`], [`Error::Invalid`] when the job has no event `after` yet, [`Error::Busy`] when too many watches are
/// open, [`Error::Draining`].
pub async fn watch(app: &Arc<App>, caller: &Caller, id: &str, after: u64) -> Result<Watch, Error> {
    let permit = app.watchers.acquire(app)?;
    let Job { row_id: job, state, last_event, spec, .. } = jobs::get(app, caller, id).await?;
    in_range("after", after, 0..=last_event)?;
    let ended = state.ended() && after == last_event;
    let (changes, caller) = (app.store.changes(job), caller.clone());
    Ok(Watch { app: app.clone(), caller, id: id.to_owned(), job, steps: spec.steps, after, ended, changes, _permit: permit })
}

impl Watch {
    /// Whether the last event was returned.
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// The events, oldest first, until the job has ended. The stream ends early with [`Error::Draining`], with
    /// [`Error::NotFound`] when the job is deleted, or with [`Error::Internal`].
    pub fn events(self) -> impl Stream<Item = Result<WatchedEvent, Error>> + Send + use<> {
        let steps = self.steps;
        let watched = move |event: JobEvent| {
            let progress = match &event.kind {
                JobEventKind::Metrics(rows) => Some(Progress::of(rows, steps)),
                JobEventKind::State { .. } => None,
            };
            WatchedEvent { event, progress }
        };
        let pages = futures::stream::try_unfold(self, |mut watch| async {
            let page = watch.page().await?;
            Ok::<_, Error>(page.map(|page| (futures::stream::iter(page.into_iter().map(Ok)), watch)))
        });
        pages.try_flatten().map_ok(watched)
    }

    /// Waits for the next events; `None` after the last.
    async fn page(&mut self) -> Result<Option<Vec<JobEvent>>, Error> {
        while !self.ended {
            self.app.admit()?;
            // Marked before reading, so that a later commit notifies again.
            self.changes.borrow_and_update();
            let events = self.app.store.events(self.job, self.after).await?;
            if let Some(last) = events.last() {
                self.after = last.id;
                self.ended = matches!(last.kind, JobEventKind::State { state, .. } if state.ended());
                return Ok(Some(events));
            }
            // A deleted job has no events either.
            jobs::get(&self.app, &self.caller, &self.id).await?;
            tokio::select! {
                changed = self.changes.changed() => changed.map_err(Error::internal)?,
                () = self.app.draining.wait() => {}
            }
        }
        Ok(None)
    }
}
