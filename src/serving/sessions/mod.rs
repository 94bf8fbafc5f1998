//! Sessions: fleets whose memory the server keeps. This file owns which sessions there are; `session` what one may do.
//!
//! The table's lock is held for look-ups, never while a policy computes. Sessions idle for longer than the time to live
//! expire: on the next look at them, or when [`Sessions::sweep`] comes by. A bounded number of expired names is
//! remembered, so that a late caller is told what happened.

mod session;

pub use session::{Answered, Session, Turn};

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use jiff::Timestamp;
use uuid::Uuid;

use super::{Clock, Error, LoadedPolicy, PolicyRef};

/// Limits of sessions.
#[derive(Clone, Copy, Debug)]
pub struct SessionsConfig {
    /// A session idle for longer expires.
    pub ttl: Duration,
    /// Most open sessions; as many expired ones are remembered.
    pub max: usize,
}

/// What a caller is told of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionInfo {
    /// Its name.
    pub id: String,
    /// The policy version it is pinned to.
    pub policy: PolicyRef,
    /// Slots answered in the current run.
    pub steps: u64,
    /// When it was opened.
    pub opened_at: Timestamp,
    /// Idle time after which it expires.
    pub ttl: Duration,
}

/// How to open a session.
#[derive(Clone, Debug, Default)]
pub struct Opened {
    /// Chosen by the server when absent.
    pub id: Option<String>,
    /// The run it begins with.
    pub run_id: Option<String>,
    /// Fixes what is random about the policy; when absent, session and run do.
    pub seed: Option<u64>,
}

#[derive(Debug, Default)]
struct Table {
    open: HashMap<String, Arc<Session>>,
    /// Expired names, each with the number of its expiry.
    expired: HashMap<String, u64>,
    expiries: VecDeque<(u64, String)>,
    count: u64,
}

impl Table {
    fn bury(&mut self, id: String, room: usize) {
        self.open.remove(&id);
        self.count += 1;
        self.expired.insert(id.clone(), self.count);
        self.expiries.push_back((self.count, id));
        while self.expiries.len() > room {
            if let Some((count, id)) = self.expiries.pop_front()
                && self.expired.get(&id) == Some(&count)
            {
                self.expired.remove(&id);
            }
        }
    }
}

/// All sessions of this server.
#[derive(Debug)]
pub struct Sessions {
    config: SessionsConfig,
    clock: Clock,
    table: RwLock<Table>,
}

impl Sessions {
    /// No sessions yet.
    pub fn new(config: SessionsConfig, clock: Clock) -> Self {
        Self { config, clock, table: RwLock::default() }
    }

    fn read(&self) -> RwLockReadGuard<'_, Table> {
        // Nothing panics while holding the lock for writing.
        self.table.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Table> {
        self.table.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Opens a session pinned to `policy`.
    ///
    /// With the name of an open session it is a retry if that session has not flown and was opened alike; with a new
    /// `run_id` it starts that session over, on the version it is pinned to.
    ///
    /// # Errors
    /// The name is taken, the run is fenced, or there are too many sessions.
    pub async fn open(&self, policy: Arc<LoadedPolicy>, how: Opened) -> Result<SessionInfo, Error> {
        let now = self.clock.now();
        let id = how.id.clone().unwrap_or_else(|| Uuid::now_v7().to_string());
        let existing = {
            let mut table = self.write();
            match table.open.get(&id).cloned().filter(|session| !session.idle_longer_than(self.config.ttl, now)) {
                Some(existing) => existing,
                None => return self.add(&mut table, policy, id, &how),
            }
        };
        existing.reopen(&policy, &how).await?;
        Ok(self.info(&existing))
    }

    fn add(&self, table: &mut Table, policy: Arc<LoadedPolicy>, id: String, how: &Opened) -> Result<SessionInfo, Error> {
        if table.open.len() >= self.config.max {
            self.sweep_table(table, self.clock.now());
        }
        if table.open.len() >= self.config.max {
            return Err(Error::Busy(format!("{} sessions are open, the most this server holds", self.config.max)));
        }
        table.expired.remove(&id);
        let session = Arc::new(Session::new(id.clone(), policy, how, self.clock.clone()));
        table.open.insert(id, session.clone());
        Ok(self.info(&session))
    }

    /// The open session `id`; asking keeps it alive.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub fn get(&self, id: &str) -> Result<Arc<Session>, Error> {
        let now = self.clock.now();
        {
            let table = self.read();
            match table.open.get(id) {
                Some(session) if !session.idle_longer_than(self.config.ttl, now) => {
                    session.touch(now);
                    return Ok(session.clone());
                }
                None if !table.expired.contains_key(id) => return Err(Error::UnknownSession(id.to_owned())),
                _ => {}
            }
        }
        let mut table = self.write();
        if table.open.get(id).is_some_and(|session| session.idle_longer_than(self.config.ttl, now)) {
            table.bury(id.to_owned(), self.config.max);
        }
        let idle = self.config.ttl.as_secs_f64();
        Err(Error::precondition(
            "session_expired",
            format!("session {id:?} expired after {idle} s without a request; open a new one"),
        ))
    }

    /// What a caller is told of session `id`; asking keeps it alive.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub fn describe(&self, id: &str) -> Result<SessionInfo, Error> {
        Ok(self.info(&*self.get(id)?))
    }

    /// Ends session `id` after the slot in flight, if there is one.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub async fn close(&self, id: &str) -> Result<SessionInfo, Error> {
        let session = self.get(id)?;
        self.write().open.remove(id);
        session.end().await;
        Ok(self.info(&session))
    }

    /// Open sessions with names after `after`, in order, at most `limit`, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<SessionInfo>, bool) {
        let now = self.clock.now();
        let table = self.read();
        let alive = |session: &&Arc<Session>| session.id() > after && !session.idle_longer_than(self.config.ttl, now);
        let mut sessions: Vec<&Arc<Session>> = table.open.values().filter(alive).collect();
        sessions.sort_unstable_by(|a, b| a.id().cmp(b.id()));
        let more = sessions.len() > limit;
        sessions.truncate(limit);
        (sessions.into_iter().map(|session| self.info(session)).collect(), more)
    }

    /// Number of open sessions, those included that are about to expire.
    pub fn len(&self) -> usize {
        self.read().open.len()
    }

    /// Whether no session is open.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Forgets the sessions that are idle for too long.
    pub fn sweep(&self) {
        let now = self.clock.now();
        self.sweep_table(&mut self.write(), now);
    }

    fn sweep_table(&self, table: &mut Table, now: Timestamp) {
        // A session that somebody holds is in use, however long the slot in flight takes.
        let idle = |session: &Arc<Session>| Arc::strong_count(session) == 1 && session.idle_longer_than(self.config.ttl, now);
        let gone: Vec<String> = table.open.iter().filter(|(_, session)| idle(session)).map(|(id, _)| id.clone()).collect();
        for id in gone {
            table.bury(id, self.config.max);
        }
    }

    fn info(&self, session: &Session) -> SessionInfo {
        session.info(self.config.ttl)
    }
}

#[cfg(test)]
mod tests;
