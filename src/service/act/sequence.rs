//! `Act` in sequences of the Open Inference Protocol: sessions that begin and end with flags of the `Act` requests.
//!
//! A sequence belongs to one policy, so the ids of two policies are independent. It is stored as a session with the name
//! `sequence:POLICY:ID`; other sessions cannot have such names.

use std::sync::Arc;
use std::time::Instant;

use super::request::{Placed, Request, Response, Sequence, SequenceId};
use super::session::{self, SessionStep};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::{App, Error, policies};
use crate::serving::{Owner, PolicySpec, Session, SessionOptions};

/// Prefix of the names of sessions that are sequences.
pub const SEQUENCE_PREFIX: &str = "sequence:";

/// Runs the policy for one slot of a sequence.
///
/// The first slot begins the sequence on the version that the policy's name resolves to at that time; sent again, it begins
/// the sequence again, with the same result. Later slots may be repeated by their step as in any session, the last one for a
/// short time after the sequence has ended.
pub(super) async fn act(
    app: &App,
    owner: &Owner,
    sequence: &Sequence,
    request: Request,
    deadline: Option<Instant>,
) -> Result<Response, Error> {
    let Some(spec) = request.policy.clone() else {
        return Err(Invalid::missing("policy", "the policy of the sequence").into());
    };
    let name = format!("{SEQUENCE_PREFIX}{}:{}", spec.name, sequence.id);
    let (session, response) = if sequence.start {
        start(app, (owner, &name), &spec, request, deadline).await?
    } else {
        let unknown = |error| match error {
            // If the policy is unknown, report that instead of the sequence.
            Error::NotFound { what: "session", .. } => match app.registry.resolve(&spec) {
                Ok(_) => not_started(&sequence.id, &spec.name),
                Err(error) => error.into(),
            },
            other => other,
        };
        let session = app.sessions.get(owner, &name).map_err(|e| unknown(e.into()))?;
        let response = session::act(app, &session, request, deadline).await.map_err(unknown)?;
        (session, response)
    };
    if sequence.end {
        session.end().await;
    }
    Ok(response)
}

fn not_started(id: &SequenceId, policy: &str) -> Error {
    let message = format!("sequence {id} of {policy} is not running; its first request needs sequence_start");
    Error::Precondition { code: ErrorCode::SequenceNotStarted, message }
}

/// Runs the first slot. If its input is invalid, a running sequence of this name continues unchanged.
async fn start(
    app: &App,
    (owner, name): (&Owner, &str),
    spec: &PolicySpec,
    request: Request,
    deadline: Option<Instant>,
) -> Result<(Arc<Session>, Response), Error> {
    if let Some(step) = request.step.filter(|&step| step != 0) {
        let message = format!("step {step} cannot begin a sequence; send step 0, or omit sequence_start");
        return Err(Error::Precondition { code: ErrorCode::WrongStep, message });
    }
    let policy = policies::resolve(app, spec).await?;
    let options = SessionOptions { seed: request.seed, flight: request.flight, ..SessionOptions::default() };
    let former = app.sessions.get(owner, name).ok();
    let session = app.sessions.start_replacing(owner, name, policy.clone(), options)?;
    let placed = Placed::new(request.input, &policy, session.flight(), request.return_motion);
    let step = match placed.and_then(|placed| SessionStep::new(placed, &policy, Some(0), None)) {
        Ok(step) => step,
        Err(error) => {
            match &former {
                Some(former) => app.sessions.restore(&session, former),
                None => app.sessions.discard(&session),
            }
            return Err(error.into());
        }
    };
    let mut guard = StartGuard { app, session, completed: false };
    let response = session::advance(app, &guard.session, step, deadline).await;
    // Large inputs are checked when they are computed.
    if let (Err(Error::Invalid(_)), Some(former)) = (&response, former) {
        app.sessions.restore(&guard.session, &former);
    }
    let response = response?;
    guard.completed = true;
    Ok((guard.session.clone(), response))
}

/// Removes the session of a sequence unless its first slot has completed.
struct StartGuard<'a> {
    app: &'a App,
    session: Arc<Session>,
    completed: bool,
}

impl Drop for StartGuard<'_> {
    fn drop(&mut self) {
        if !self.completed {
            self.app.sessions.discard(&self.session);
        }
    }
}
