//! Sequences, as the Open Inference Protocol has them: sessions that begin and end with flags of the requests that fly them.
//!
//! A sequence belongs to one policy, so two policies may each have a sequence 5. It is a session of the name
//! `sequence:POLICY:ID`, and no other session has such a name.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use super::act::{Answer, Request, TurnRequest, advance, in_session, slot_of};
use super::{App, Error};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::serving::{Observation, PolicySpec, Session};

/// How the names of sessions begin that are sequences.
pub const PREFIX: &str = "sequence:";

/// Where a request stands in a sequence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// Which.
    pub id: SequenceId,
    /// It begins with this slot, even if one of this id is under way.
    pub start: bool,
    /// It ends after this slot.
    pub end: bool,
}

/// What a caller calls a sequence; 5 and "5" are two.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SequenceId {
    /// A number.
    Number(u64),
    /// A name.
    Name(String),
}

impl fmt::Display for SequenceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => number.fmt(f),
            Self::Name(name) => write!(f, "{name:?}"),
        }
    }
}

/// Answers one slot of a sequence.
///
/// The first slot begins the sequence on the version that the policy's name means then; sent again it begins it again, with
/// the same answer. Later slots may be repeated by their step as in any session, the last one for a moment after the end.
///
/// # Errors
/// As [`super::act::act`], and a sequence that has not been started.
pub(super) async fn act(app: &App, sequence: &Sequence, request: Request, deadline: Option<Instant>) -> Result<Answer, Error> {
    let Some(spec) = request.policy.clone() else {
        return Err(Invalid::missing("policy", "the policy of the sequence").into());
    };
    let name = format!("{PREFIX}{}:{}", spec.name, sequence.id);
    let (session, answer) = if sequence.start {
        start(app, &name, &spec, request, deadline).await?
    } else {
        let unknown = |error| match error {
            // An unknown policy has no sequences, and that is what is wrong.
            Error::NotFound { what: "session", .. } => match app.registry.resolve(&spec) {
                Ok(_) => not_started(&sequence.id, &spec.name),
                Err(error) => error.into(),
            },
            other => other,
        };
        let session = app.sessions.get(&name).map_err(|e| unknown(e.into()))?;
        let answer = in_session(app, &session, request, deadline).await.map_err(unknown)?;
        (session, answer)
    };
    if sequence.end {
        session.finish().await;
    }
    Ok(answer)
}

fn not_started(id: &SequenceId, policy: &str) -> Error {
    let message = format!("sequence {id} of {policy} is not under way; its first request needs sequence_start");
    Error::Precondition { code: ErrorCode::SequenceNotStarted, message }
}

/// The first slot. One that is refused for what it observes leaves a sequence under way as it is.
async fn start(
    app: &App,
    name: &str,
    spec: &PolicySpec,
    request: Request,
    deadline: Option<Instant>,
) -> Result<(Arc<Session>, Answer), Error> {
    if let Some(step) = request.step.filter(|&step| step != 0) {
        let message = format!("step {step} cannot begin a sequence; send step 0, or no sequence_start");
        return Err(Error::Precondition { code: ErrorCode::WrongStep, message });
    }
    let policy = app.registry.resolve(spec)?;
    let Observation { fleet, uav_order, seen } = request.observation;
    let slot = slot_of(&fleet, seen, &policy).await?;
    let turn = TurnRequest { fleet, uav_order, slot, step: Some(0), run_id: None };
    let mut begun = Begun { app, session: app.sessions.begin(name, policy, request.seed)?, flown: false };
    let answer = advance(app, &begun.session, turn, deadline).await?;
    begun.flown = true;
    Ok((begun.session.clone(), answer))
}

/// A sequence that is forgotten again unless its first slot is answered.
struct Begun<'a> {
    app: &'a App,
    session: Arc<Session>,
    flown: bool,
}

impl Drop for Begun<'_> {
    fn drop(&mut self) {
        if !self.flown {
            self.app.sessions.discard(&self.session);
        }
    }
}
