//! Where an answer is left for its caller. Used again and again, so that an `Act` in steady state allocates nothing here.
//!
//! Two hold a place: the caller ([`Expected`]) and whoever computes ([`Promise`]). Whoever is the second to be done with it
//! gives it back; until then nobody else is given it.

use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use super::Outcome;
use crate::serving::Error;

/// Most places kept for later.
const KEPT: usize = 1024;

#[derive(Default)]
enum State {
    /// Nobody looked yet.
    #[default]
    Open,
    /// The caller waits.
    Awaited(Waker),
    /// The answer is there.
    Kept(Result<Outcome, Error>),
    /// The caller left.
    Left,
}

#[derive(Default)]
struct Place(Mutex<State>);

impl Place {
    fn lock(&self) -> MutexGuard<'_, State> {
        // A state is replaced whole.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Places that nobody holds.
#[derive(Default)]
pub(super) struct Places(Mutex<Vec<Arc<Place>>>);

impl Places {
    fn lock(&self) -> MutexGuard<'_, Vec<Arc<Place>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place, from both sides.
    pub(super) fn pair(self: &Arc<Self>) -> (Promise, Expected) {
        let place = self.lock().pop().unwrap_or_default();
        (Promise { place: Some(place.clone()), places: self.clone() }, Expected { place: Some(place), places: self.clone() })
    }

    fn take_back(&self, place: Arc<Place>) {
        let mut free = self.lock();
        if free.len() < KEPT {
            free.push(place);
        }
    }
}

/// The duty to answer; dropped without an answer it tells of a fault.
pub(super) struct Promise {
    place: Option<Arc<Place>>,
    places: Arc<Places>,
}

impl Promise {
    /// Whether nobody waits any more.
    pub(super) fn is_void(&self) -> bool {
        self.place.as_ref().is_none_or(|place| matches!(*place.lock(), State::Left))
    }

    /// Answers; whether somebody was there to hear it.
    pub(super) fn keep(mut self, answer: Result<Outcome, Error>) -> bool {
        self.settle(answer)
    }

    fn settle(&mut self, answer: Result<Outcome, Error>) -> bool {
        let Some(place) = self.place.take() else { return false };
        let mut state = place.lock();
        match std::mem::take(&mut *state) {
            State::Left => {
                drop(state);
                self.places.take_back(place);
                return false;
            }
            State::Awaited(waker) => {
                *state = State::Kept(answer);
                drop(state);
                waker.wake();
            }
            State::Open | State::Kept(_) => *state = State::Kept(answer),
        }
        true
    }
}

impl Drop for Promise {
    fn drop(&mut self) {
        if self.place.is_some() {
            self.settle(Err(Error::Fault("the engine lost a request".into())));
        }
    }
}

/// The answer to come; dropped, nobody waits for it.
pub(super) struct Expected {
    place: Option<Arc<Place>>,
    places: Arc<Places>,
}

impl Expected {
    /// The answer, if it is there.
    pub(super) fn look(&mut self) -> Option<Result<Outcome, Error>> {
        let mut state = self.place.as_ref()?.lock();
        if !matches!(*state, State::Kept(_)) {
            return None;
        }
        let State::Kept(answer) = std::mem::take(&mut *state) else { return None };
        drop(state);
        self.give_back();
        Some(answer)
    }

    fn give_back(&mut self) {
        if let Some(place) = self.place.take() {
            self.places.take_back(place);
        }
    }
}

impl Future for Expected {
    type Output = Result<Outcome, Error>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if let Some(answer) = self.look() {
            return Poll::Ready(answer);
        }
        let Some(place) = &self.place else { return Poll::Ready(Err(Error::Fault("an answer was taken twice".into()))) };
        let mut state = place.lock();
        if let State::Kept(_) = *state {
            // It came between the two looks.
            drop(state);
            return self.look().map_or(Poll::Pending, Poll::Ready);
        }
        *state = State::Awaited(context.waker().clone());
        Poll::Pending
    }
}

impl Drop for Expected {
    fn drop(&mut self) {
        let Some(place) = &self.place else { return };
        let mut state = place.lock();
        match std::mem::replace(&mut *state, State::Left) {
            State::Kept(_) => {
                *state = State::Open;
                drop(state);
                self.give_back();
            }
            // Who computes gives it back.
            State::Open | State::Awaited(_) | State::Left => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> Result<Outcome, Error> {
        Err(Error::Fault(text.into()))
    }

    fn told(answer: Result<Outcome, Error>) -> String {
        answer.expect_err("only faults are sent here").to_string()
    }

    #[tokio::test]
    async fn a_place_is_given_again_only_when_both_sides_are_done() {
        let places = Arc::new(Places::default());
        let free = || places.lock().len();
        let (promise, mut expected) = places.pair();
        assert!(expected.look().is_none() && !promise.is_void());
        promise.keep(fault("1"));
        assert_eq!(free(), 0);
        assert!(told(expected.await).contains('1'));
        assert_eq!(free(), 1);
        // Who leaves first does not free it.
        let (promise, expected) = places.pair();
        drop(expected);
        assert_eq!(free(), 0);
        assert!(promise.is_void());
        promise.keep(fault("2"));
        assert_eq!(free(), 1);
        // Nothing of the answer nobody took is left for the next.
        let (promise, mut expected) = places.pair();
        assert!(expected.look().is_none());
        promise.keep(fault("3"));
        drop(expected);
        assert_eq!(free(), 1);
        let (promise, mut expected) = places.pair();
        assert!(expected.look().is_none() && !promise.is_void());
        let waiting = tokio::spawn(expected);
        tokio::task::yield_now().await;
        drop(promise);
        assert!(told(waiting.await.unwrap()).contains("lost"));
        assert_eq!(free(), 1);
    }
}
