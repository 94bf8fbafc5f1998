//! Clients that send and time requests: closed loop (each sends when it has its last answer) or open loop (requests are due at
//! fixed times and timed from then, so that a slow answer is not hidden by the requests it held up).

use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::future::try_join_all;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use super::figures::Samples;
use super::world::World;
use crate::cli::fly::Server;
use crate::wire::v1;
use crate::wire::v1::act_result::Result as Told;

/// When the next request is sent.
#[derive(Clone, Copy, Debug)]
pub(super) enum Pace {
    /// When the last one is answered.
    Answers,
    /// So many per second, of all clients together.
    Rate(f64),
}

/// Time that a client whose call failed waits.
const PAUSE: Duration = Duration::from_millis(10);

/// One session: its world and its way to the server.
pub(super) struct Client {
    world: World,
    server: Server,
    stream: Option<(mpsc::Sender<v1::ActRequest>, Streaming<v1::ActResult>)>,
}

impl Client {
    /// A client whose session is open.
    ///
    /// # Errors
    /// The stream is refused.
    pub(super) async fn new(mut server: Server, world: World, stream: bool) -> Result<Self, Status> {
        let stream = if stream {
            let (ask, asked) = mpsc::channel(1);
            Some((ask, server.act_stream(ReceiverStream::new(asked)).await?.into_inner()))
        } else {
            None
        };
        Ok(Self { world, server, stream })
    }

    /// Ends its session.
    pub(super) async fn close(mut self) {
        drop(self.stream.take());
        // If it is not closed it expires.
        let _ = self.server.close_session(v1::CloseSessionRequest { session_id: self.world.session().to_owned() }).await;
    }

    /// Sends a request; the code it failed with otherwise.
    async fn send(&mut self, request: v1::ActRequest) -> Result<v1::ActResponse, Code> {
        let Some((ask, answers)) = &mut self.stream else {
            return self.server.act(request).await.map(tonic::Response::into_inner).map_err(|status| status.code());
        };
        ask.send(request).await.map_err(|_| Code::Unavailable)?;
        match answers.next().await {
            Some(Ok(v1::ActResult { result: Some(Told::Response(answer)) })) => Ok(answer),
            Some(Ok(v1::ActResult { result: Some(Told::Error(error)) })) => Err(Code::from(error.status)),
            Some(Ok(v1::ActResult { result: None })) => Err(Code::Unknown),
            Some(Err(status)) => Err(status.code()),
            None => Err(Code::Unavailable),
        }
    }

    /// Flies a slot and notes how long its answer took, counted from `due` or from now.
    async fn slot(&mut self, due: Option<Instant>, samples: &mut Samples) -> anyhow::Result<()> {
        let request = self.world.request();
        let begin = due.unwrap_or_else(Instant::now);
        match self.send(request).await {
            Ok(answer) => {
                samples.latencies.push(begin.elapsed());
                self.world.fly(&answer)?;
            }
            Err(code) => {
                samples.fail(name(code));
                self.world.restart();
                tokio::time::sleep(PAUSE).await;
            }
        }
        Ok(())
    }
}

/// Lets all clients send for `time`; returns them with what they measured.
///
/// # Errors
/// An answer that cannot be flown.
pub(super) async fn round(clients: Vec<Client>, pace: Pace, time: Duration) -> anyhow::Result<(Vec<Client>, Samples)> {
    let begin = Instant::now();
    let end = begin + time;
    let mut due = Vec::new();
    let mut tasks = Vec::new();
    for mut client in clients {
        let (tick, mut ticks) = mpsc::unbounded_channel::<Instant>();
        due.push(tick);
        tasks.push(tokio::spawn(async move {
            let mut samples = Samples::default();
            match pace {
                Pace::Answers => {
                    while Instant::now() < end {
                        client.slot(None, &mut samples).await?;
                    }
                }
                Pace::Rate(_) => {
                    while let Some(due) = ticks.recv().await {
                        if Instant::now() < end {
                            client.slot(Some(due), &mut samples).await?;
                        } else {
                            samples.unsent.push(end.saturating_duration_since(due));
                        }
                    }
                }
            }
            anyhow::Ok((client, samples))
        }));
    }
    if let Pace::Rate(rate) = pace {
        // A thread of its own: the runtime's timers tick in milliseconds.
        std::thread::spawn(move || schedule(begin, end, rate, &due));
    }
    let mut samples = Samples::default();
    let mut clients = Vec::new();
    for done in try_join_all(tasks).await? {
        let (client, measured) = done?;
        clients.push(client);
        samples.merge(measured);
    }
    samples.elapsed = begin.elapsed();
    Ok((clients, samples))
}

/// Tells clients, in turn, when a request is due, as soon as it is.
fn schedule(begin: Instant, end: Instant, rate: f64, clients: &[mpsc::UnboundedSender<Instant>]) {
    for (number, client) in (0_u64..).zip(clients.iter().cycle()) {
        let due = begin + Duration::from_secs_f64(number as f64 / rate);
        if due >= end {
            return;
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        if client.send(due).is_err() {
            return;
        }
    }
}

/// A code as gRPC's documents write it.
pub(super) fn name(code: Code) -> String {
    format!("{code:?}").chars().fold(String::new(), |mut name, c| {
        if c.is_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.push(c.to_ascii_uppercase());
        name
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_due_at_the_rate_and_in_turn() {
        let (a, mut due_a) = mpsc::unbounded_channel();
        let (b, mut due_b) = mpsc::unbounded_channel();
        let begin = Instant::now();
        schedule(begin, begin + Duration::from_millis(5), 1000.0, &[a, b]);
        let mut taken = |which: usize| if which == 0 { due_a.try_recv() } else { due_b.try_recv() };
        for number in 0..5 {
            assert_eq!(taken(number % 2), Ok(begin + Duration::from_secs_f64(number as f64 / 1000.0)));
        }
        assert!(taken(0).is_err() && taken(1).is_err(), "none is due at the end");
    }

    #[test]
    fn codes_are_written_as_in_the_documents() {
        assert_eq!(name(Code::Ok), "OK");
        assert_eq!(name(Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    }
}
