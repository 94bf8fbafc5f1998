//! Following a job: what has happened to it and what happens, in the order in which it was committed, until it has ended.
//!
//! A watch reads a page when it is asked for one: a caller that reads slowly holds a page and no more. How many watches
//! there are at a time is bounded.

use std::sync::Arc;
use std::time::Duration;

use futures::{Stream, TryStreamExt};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::{App, Error, jobs};
use crate::invalid::in_range;
use crate::store::{Happened, Job, JobEvent};

/// Who may watch, and how often they hear that the server lives.
#[derive(Debug)]
pub struct Watchers {
    free: Arc<Semaphore>,
    most: usize,
    heartbeat: Duration,
}

impl Watchers {
    /// At most `most` watches at a time; a silent one gives a sign of life every `heartbeat`, where the transport has none.
    pub fn new(most: usize, heartbeat: Duration) -> Self {
        Self { free: Arc::new(Semaphore::new(most)), most, heartbeat }
    }

    /// Watches that are open.
    pub fn open(&self) -> usize {
        self.most - self.free.available_permits()
    }

    /// Silence after which a watch gives a sign of life.
    pub fn heartbeat(&self) -> Duration {
        self.heartbeat
    }
}

/// A job that is followed.
pub struct Watch {
    app: Arc<App>,
    id: String,
    job: i64,
    after: u64,
    over: bool,
    changes: watch::Receiver<()>,
    _place: OwnedSemaphorePermit,
}

/// Follows job `id` behind its event `after`; 0: from its beginning.
///
/// # Errors
/// There is no such job or event, there are too many watches, or the server drains.
pub async fn watch(app: &Arc<App>, id: &str, after: u64) -> Result<Watch, Error> {
    app.admit()?;
    let Watchers { free, most, .. } = &app.watchers;
    let place = free.clone().try_acquire_owned().map_err(|_| Error::Busy {
        message: format!("{most} jobs are watched already, which is the limit"),
        retry_after: Duration::from_secs(5),
    })?;
    let Job { number: job, state, last_event, .. } = jobs::get(app, id).await?;
    in_range("after", after, 0..=last_event)?;
    let over = state.ended() && after == last_event;
    Ok(Watch { app: app.clone(), id: id.to_owned(), job, after, over, changes: app.store.changes(job), _place: place })
}

impl Watch {
    /// Whether nothing more will come.
    pub fn is_over(&self) -> bool {
        self.over
    }

    /// The events, oldest first, until the job has ended; with [`Error::Draining`], [`Error::NotFound`] where the job is
    /// deleted, or a fault of the database at its end otherwise.
    pub fn events(self) -> impl Stream<Item = Result<JobEvent, Error>> + Send + use<> {
        let pages = futures::stream::try_unfold(self, |mut watch| async {
            let page = watch.page().await?;
            Ok::<_, Error>(page.map(|page| (futures::stream::iter(page.into_iter().map(Ok)), watch)))
        });
        pages.try_flatten()
    }

    /// The next events as soon as there are some; `None` behind the last.
    async fn page(&mut self) -> Result<Option<Vec<JobEvent>>, Error> {
        while !self.over {
            self.app.admit()?;
            // Marked before it is looked: what is committed from now on rings again.
            self.changes.borrow_and_update();
            let events = self.app.store.events(self.job, self.after).await?;
            if let Some(last) = events.last() {
                self.after = last.id;
                self.over = matches!(last.what, Happened::State { state, .. } if state.ended());
                return Ok(Some(events));
            }
            // A job that is gone has no events either.
            jobs::get(&self.app, &self.id).await?;
            tokio::select! {
                changed = self.changes.changed() => changed.map_err(Error::internal)?,
                () = self.app.draining.wait() => {}
            }
        }
        Ok(None)
    }
}
