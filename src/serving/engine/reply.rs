//! Where an answer is left for its caller. Used again and again, so that an `Act` in steady state allocates nothing here.
//!
//! Two hold a slot: the caller ([`Receiver`]) and whoever computes ([`Sender`]). Whoever is the second to be done with it
//! gives it back; until then nobody else is given it.

use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use super::task::TaskOutput;
use crate::serving::Error;

/// Most slots kept for later.
const KEPT: usize = 1024;

#[derive(Default)]
enum ReplyState {
    /// Nobody looked yet.
    #[default]
    Pending,
    /// The caller waits.
    Waiting(Waker),
    /// The answer is there.
    Ready(Result<TaskOutput, Error>),
    /// The caller left.
    Closed,
}

#[derive(Default)]
struct ReplySlot(Mutex<ReplyState>);

impl ReplySlot {
    fn lock(&self) -> MutexGuard<'_, ReplyState> {
        // A state is replaced whole.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// ReplySlots that nobody holds.
#[derive(Default)]
pub(super) struct ReplySlots(Mutex<Vec<Arc<ReplySlot>>>);

impl ReplySlots {
    fn lock(&self) -> MutexGuard<'_, Vec<Arc<ReplySlot>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A slot, from both sides.
    pub(super) fn channel(self: &Arc<Self>) -> (Sender, Receiver) {
        let slot = self.lock().pop().unwrap_or_default();
        (Sender { slot: Some(slot.clone()), slots: self.clone() }, Receiver { slot: Some(slot), slots: self.clone() })
    }

    fn take_back(&self, slot: Arc<ReplySlot>) {
        let mut free = self.lock();
        if free.len() < KEPT {
            free.push(slot);
        }
    }
}

/// The duty to answer; dropped without an answer it tells of a fault.
pub(super) struct Sender {
    slot: Option<Arc<ReplySlot>>,
    slots: Arc<ReplySlots>,
}

impl Sender {
    /// Whether nobody waits any more.
    pub(super) fn is_closed(&self) -> bool {
        self.slot.as_ref().is_none_or(|slot| matches!(*slot.lock(), ReplyState::Closed))
    }

    /// Answers; whether somebody was there to hear it.
    pub(super) fn send(mut self, answer: Result<TaskOutput, Error>) -> bool {
        self.settle(answer)
    }

    fn settle(&mut self, answer: Result<TaskOutput, Error>) -> bool {
        let Some(slot) = self.slot.take() else { return false };
        let mut state = slot.lock();
        match std::mem::take(&mut *state) {
            ReplyState::Closed => {
                drop(state);
                self.slots.take_back(slot);
                return false;
            }
            ReplyState::Waiting(waker) => {
                *state = ReplyState::Ready(answer);
                drop(state);
                waker.wake();
            }
            ReplyState::Pending | ReplyState::Ready(_) => *state = ReplyState::Ready(answer),
        }
        true
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        if self.slot.is_some() {
            self.settle(Err(Error::Fault("the engine lost a request".into())));
        }
    }
}

/// The answer to come; dropped, nobody waits for it.
pub(super) struct Receiver {
    slot: Option<Arc<ReplySlot>>,
    slots: Arc<ReplySlots>,
}

impl Receiver {
    /// The answer, if it is there.
    pub(super) fn try_recv(&mut self) -> Option<Result<TaskOutput, Error>> {
        let mut state = self.slot.as_ref()?.lock();
        if !matches!(*state, ReplyState::Ready(_)) {
            return None;
        }
        let ReplyState::Ready(answer) = std::mem::take(&mut *state) else { return None };
        drop(state);
        self.give_back();
        Some(answer)
    }

    fn give_back(&mut self) {
        if let Some(slot) = self.slot.take() {
            self.slots.take_back(slot);
        }
    }
}

impl Future for Receiver {
    type Output = Result<TaskOutput, Error>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if let Some(answer) = self.try_recv() {
            return Poll::Ready(answer);
        }
        let Some(slot) = &self.slot else { return Poll::Ready(Err(Error::Fault("an answer was taken twice".into()))) };
        let mut state = slot.lock();
        if let ReplyState::Ready(_) = *state {
            // It came between the two looks.
            drop(state);
            return self.try_recv().map_or(Poll::Pending, Poll::Ready);
        }
        *state = ReplyState::Waiting(context.waker().clone());
        Poll::Pending
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        let Some(slot) = &self.slot else { return };
        let mut state = slot.lock();
        match std::mem::replace(&mut *state, ReplyState::Closed) {
            ReplyState::Ready(_) => {
                *state = ReplyState::Pending;
                drop(state);
                self.give_back();
            }
            // Who computes gives it back.
            ReplyState::Pending | ReplyState::Waiting(_) | ReplyState::Closed => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> Result<TaskOutput, Error> {
        Err(Error::Fault(text.into()))
    }

    fn told(answer: Result<TaskOutput, Error>) -> String {
        answer.expect_err("only faults are sent here").to_string()
    }

    #[tokio::test]
    async fn a_place_is_given_again_only_when_both_sides_are_done() {
        let slots = Arc::new(ReplySlots::default());
        let free = || slots.lock().len();
        let (sender, mut receiver) = slots.channel();
        assert!(receiver.try_recv().is_none() && !sender.is_closed());
        sender.send(fault("1"));
        assert_eq!(free(), 0);
        assert!(told(receiver.await).contains('1'));
        assert_eq!(free(), 1);
        // Who leaves first does not free it.
        let (sender, receiver) = slots.channel();
        drop(receiver);
        assert_eq!(free(), 0);
        assert!(sender.is_closed());
        sender.send(fault("2"));
        assert_eq!(free(), 1);
        // Nothing of the answer nobody took is left for the next.
        let (sender, mut receiver) = slots.channel();
        assert!(receiver.try_recv().is_none());
        sender.send(fault("3"));
        drop(receiver);
        assert_eq!(free(), 1);
        let (sender, mut receiver) = slots.channel();
        assert!(receiver.try_recv().is_none() && !sender.is_closed());
        let waiting = tokio::spawn(receiver);
        tokio::task::yield_now().await;
        drop(sender);
        assert!(told(waiting.await.unwrap()).contains("lost"));
        assert_eq!(free(), 1);
    }
}
