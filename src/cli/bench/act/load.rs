//! Clients that send requests and measure latencies.
//!
//! Closed loop: each client sends its next request when it has the previous response. Open loop: requests are due at fixed
//! times, and latencies count from those times, so that a slow response also shows in the latencies of the requests that it
//! delays.

use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::future::try_join_all;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use super::fleet::SimulatedFleet;
use super::metrics::CallSamples;
use crate::cli::act_client::PolicyClient;
use crate::wire::v1;
use crate::wire::v1::act_result::Result as ActResult;

/// When clients send requests.
#[derive(Clone, Copy, Debug)]
pub(super) enum LoadMode {
    /// When the previous response has arrived.
    ClosedLoop,
    /// At this rate per second, of all clients together.
    OpenLoop(f64),
}

/// Pause of a client after a failed call.
const ERROR_PAUSE: Duration = Duration::from_millis(10);

/// One session: its simulated fleet and its connection.
pub(super) struct LoadClient {
    fleet: SimulatedFleet,
    server: PolicyClient,
    stream: Option<(mpsc::Sender<v1::ActRequest>, Streaming<v1::ActResult>)>,
    /// Whether the fleet follows the responses; otherwise it circles.
    follows: bool,
}

impl LoadClient {
    /// Creates a client of an open session. With `stream`, opens an `ActStream`. `follows`: whether the fleet follows the responses;
    /// otherwise it circles.
    ///
    /// # Errors
    /// The server refuses the stream.
    pub(super) async fn new(
        mut server: PolicyClient,
        fleet: SimulatedFleet,
        (stream, follows): (bool, bool),
    ) -> Result<Self, Status> {
        let stream = if stream {
            let (sender, requests) = mpsc::channel(1);
            Some((sender, server.act_stream(ReceiverStream::new(requests)).await?.into_inner()))
        } else {
            None
        };
        Ok(Self { fleet, server, stream, follows })
    }

    /// Closes the session.
    pub(super) async fn close(mut self) {
        drop(self.stream.take());
        // A session that cannot be closed expires.
        let _ = self.server.close_session(v1::CloseSessionRequest { session_id: self.fleet.session().to_owned() }).await;
    }

    /// Sends a request and returns the response, or the status code of the failure.
    async fn send(&mut self, request: v1::ActRequest) -> Result<v1::ActResponse, Code> {
        let Some((sender, responses)) = &mut self.stream else {
            return self.server.act(request).await.map(tonic::Response::into_inner).map_err(|status| status.code());
        };
        sender.send(request).await.map_err(|_| Code::Unavailable)?;
        match responses.next().await {
            Some(Ok(v1::ActResult { result: Some(ActResult::Response(response)) })) => Ok(response),
            Some(Ok(v1::ActResult { result: Some(ActResult::Error(error)) })) => Err(Code::from(error.status)),
            Some(Ok(v1::ActResult { result: None })) => Err(Code::Unknown),
            Some(Err(status)) => Err(status.code()),
            None => Err(Code::Unavailable),
        }
    }

    /// Runs one slot and records its latency, which counts from `due` or from now.
    async fn slot(&mut self, due: Option<Instant>, samples: &mut CallSamples) -> anyhow::Result<()> {
        let request = self.fleet.request();
        let begin = due.unwrap_or_else(Instant::now);
        match self.send(request).await {
            Ok(response) => {
                samples.latencies.push(begin.elapsed());
                if self.follows { self.fleet.step(&response)? } else { self.fleet.circle()? }
            }
            Err(code) => {
                samples.fail(code_name(code));
                self.fleet.next_episode();
                tokio::time::sleep(ERROR_PAUSE).await;
            }
        }
        Ok(())
    }
}

/// Lets all clients send for `time`, and returns them with their samples.
///
/// # Errors
/// A response does not have one heading per UAV.
pub(super) async fn round(
    clients: Vec<LoadClient>,
    mode: LoadMode,
    time: Duration,
) -> anyhow::Result<(Vec<LoadClient>, CallSamples)> {
    let begin = Instant::now();
    let end = begin + time;
    let mut due = Vec::new();
    let mut tasks = Vec::new();
    for mut client in clients {
        let (tick, mut ticks) = mpsc::unbounded_channel::<Instant>();
        due.push(tick);
        tasks.push(tokio::spawn(async move {
            let mut samples = CallSamples::default();
            match mode {
                LoadMode::ClosedLoop => {
                    while Instant::now() < end {
                        client.slot(None, &mut samples).await?;
                    }
                }
                LoadMode::OpenLoop(_) => {
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
    if let LoadMode::OpenLoop(rate) = mode {
        // On a thread, because timers of the runtime have a resolution of 1 ms.
        std::thread::spawn(move || schedule(begin, end, rate, &due));
    }
    let mut samples = CallSamples::default();
    let mut clients = Vec::new();
    for done in try_join_all(tasks).await? {
        let (client, measured) = done?;
        clients.push(client);
        samples.merge(measured);
    }
    samples.elapsed = begin.elapsed();
    Ok((clients, samples))
}

/// Sends the due times of requests to the clients in turn, each when it is reached.
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

/// Name of a status code as in the gRPC documentation, such as `DEADLINE_EXCEEDED`.
pub(super) fn code_name(code: Code) -> String {
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
    fn due_times_follow_the_rate_and_alternate_between_clients() {
        let (a, mut due_a) = mpsc::unbounded_channel();
        let (b, mut due_b) = mpsc::unbounded_channel();
        let begin = Instant::now();
        schedule(begin, begin + Duration::from_millis(5), 1000.0, &[a, b]);
        let mut receive = |which: usize| if which == 0 { due_a.try_recv() } else { due_b.try_recv() };
        for number in 0..5 {
            assert_eq!(receive(number % 2), Ok(begin + Duration::from_secs_f64(number as f64 / 1000.0)));
        }
        assert!(receive(0).is_err() && receive(1).is_err(), "no request is due at the end");
    }

    #[test]
    fn codes_have_their_documented_names() {
        assert_eq!(code_name(Code::Ok), "OK");
        assert_eq!(code_name(Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    }
}
