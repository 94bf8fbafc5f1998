//! The events of a job as they happen, also across restarts of the server.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use anyhow::Context;
use serde::Deserialize;
use serde_json::Value;

use crate::cli::client::{Client, ClientError};

/// Time without a byte after which the connection counts as lost; the server sends a comment every `--event-heartbeat`.
const SILENCE: Duration = Duration::from_secs(90);
/// First and longest time between two tries to reach the server.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Time after which a server that cannot be reached is given up. Workers wait as long.
const PATIENCE: Duration = Duration::from_secs(3600);
/// Maximum size of an event.
const MAX_EVENT: usize = 64 << 20;

/// An event of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct ServerEvent {
    /// Its id.
    pub id: u64,
    /// Its kind, such as `state`.
    pub event: String,
    /// Its content.
    pub data: Value,
}

/// What an event says.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub enum JobEvent {
    /// The job changed its state.
    State {
        /// The new state.
        state: String,
        /// The newest attempt.
        attempt: u64,
        /// Why.
        reason: Option<String>,
    },
    /// Metrics arrived.
    Metrics {
        /// The metrics.
        metrics: Vec<MetricRow>,
    },
}

/// A metric at one step.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub struct MetricRow {
    /// Name of the metric.
    pub name: String,
    /// Environment steps.
    pub step: u64,
    /// Value; none if it is not finite.
    pub value: Option<f64>,
}

/// What happens while a job is followed.
#[derive(Debug)]
pub enum Followed {
    /// An event of the job.
    Event(ServerEvent),
    /// The server cannot be reached; it is tried again.
    Lost(ClientError),
    /// The server can be reached again.
    Found,
    /// The job has ended, and all its events were returned.
    Ended,
}

impl ServerEvent {
    /// What the event says; `None` for a kind of events that this version does not know.
    pub fn content(&self) -> Option<JobEvent> {
        JobEvent::deserialize(&self.data).ok()
    }
}

/// Follows one job.
pub struct Follower<'a> {
    client: &'a Client,
    path: String,
    /// Id of the last event that was returned.
    after: u64,
    connection: Option<Connection>,
    /// Tries since the last event, and when the first of them began.
    tries: u32,
    lost: Option<Instant>,
    told: bool,
}

/// A stream of events.
struct Connection {
    response: reqwest::Response,
    parser: SseParser,
    ready: VecDeque<ServerEvent>,
}

impl<'a> Follower<'a> {
    /// Follows the job with this id, from the event after `after` on.
    pub fn new(client: &'a Client, id: &str, after: u64) -> Self {
        let path = format!("/v1/jobs/{id}/events");
        Self { client, path, after, connection: None, tries: 0, lost: None, told: false }
    }

    /// Waits for the next event. Dropping the future loses no event.
    ///
    /// # Errors
    /// The server refuses the request, or could not be reached for an hour.
    pub async fn next(&mut self) -> anyhow::Result<Followed> {
        loop {
            if let Some(connection) = &mut self.connection {
                if let Some(event) = connection.ready.pop_front() {
                    self.after = event.id;
                    (self.tries, self.lost) = (0, None);
                    return Ok(Followed::Event(event));
                }
                if connection.read().await.is_none() {
                    // The end of the job, of the server or of the network; the next request tells.
                    self.connection = None;
                }
                continue;
            }
            if self.tries > 0 {
                let wait = BACK_OFF[0].saturating_mul(1 << self.tries.min(8)).min(BACK_OFF[1]);
                tokio::time::sleep(wait / 2).await;
            }
            self.tries += 1;
            match self.client.stream(&format!("{}?after={}", self.path, self.after)).await {
                Ok(response) if response.status() == 204 => return Ok(Followed::Ended),
                Ok(response) => {
                    self.connection = Some(Connection { response, parser: SseParser::default(), ready: VecDeque::new() });
                    if std::mem::take(&mut self.told) {
                        return Ok(Followed::Found);
                    }
                }
                Err(error) if error.is_temporary() => {
                    let lost = *self.lost.get_or_insert_with(Instant::now);
                    if lost.elapsed() > PATIENCE {
                        return Err(error).context("the server could not be reached for an hour");
                    }
                    if !std::mem::replace(&mut self.told, true) {
                        return Ok(Followed::Lost(error));
                    }
                }
                Err(error) => return Err(error.into()),
            }
        }
    }
}

impl Connection {
    /// Reads more of the stream; `None` at its end, or if it breaks.
    async fn read(&mut self) -> Option<()> {
        let bytes = tokio::time::timeout(SILENCE, self.response.chunk()).await.ok()?.ok()??;
        self.parser.push(&bytes, &mut self.ready)
    }
}

/// Parses `text/event-stream`.
#[derive(Default)]
struct SseParser {
    line: Vec<u8>,
    id: u64,
    event: String,
    data: String,
}

impl SseParser {
    /// Adds bytes of the stream and the events that are complete to `events`; `None` if an event is malformed or too large.
    fn push(&mut self, bytes: &[u8], events: &mut VecDeque<ServerEvent>) -> Option<()> {
        for part in bytes.split_inclusive(|&byte| byte == b'\n') {
            self.line.extend_from_slice(part);
            if self.line.len() + self.data.len() > MAX_EVENT {
                return None;
            }
            if self.line.pop_if(|last| *last == b'\n').is_some() {
                self.line.pop_if(|last| *last == b'\r');
                let line = String::from_utf8(std::mem::take(&mut self.line)).ok()?;
                events.extend(self.end_line(&line)?);
            }
        }
        Some(())
    }

    /// Returns the event that the line ends, if it ends one.
    fn end_line(&mut self, line: &str) -> Option<Option<ServerEvent>> {
        if line.is_empty() {
            let (event, data) = (std::mem::take(&mut self.event), std::mem::take(&mut self.data));
            if data.is_empty() {
                return Some(None);
            }
            return Some(Some(ServerEvent { id: self.id, event, data: serde_json::from_str(&data).ok()? }));
        }
        let (field, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "id" => self.id = value.parse().ok()?,
            "event" => value.clone_into(&mut self.event),
            "data" => self.data.push_str(value),
            // A comment, or a field that this version does not know.
            _ => {}
        }
        Some(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STREAM: &str = ": hello\n\nid: 2\nevent: state\ndata: {\"state\":\"running\",\"attempt\":1,\"reason\":null,\"at\":\"x\"}\n\n\
                          :\nid: 3\r\nevent: metrics\r\ndata:{\"metrics\":[{\"name\":\"loss\",\"step\":1,\"value\":null,\"at\":\"y\"}]}\r\n\r\n\
                          id: 4\nevent: weather\ndata: 5\n\n";

    #[test]
    fn events_are_parsed_however_the_stream_is_cut() {
        for size in 1..STREAM.len() {
            let (mut parser, mut events) = (SseParser::default(), VecDeque::new());
            STREAM.as_bytes().chunks(size).for_each(|part| parser.push(part, &mut events).unwrap());
            assert_eq!(events.iter().map(|event| event.id).collect::<Vec<_>>(), [2, 3, 4], "{size}");
            assert!(matches!(events[0].content(), Some(JobEvent::State { attempt: 1, .. })));
            assert!(matches!(events[1].content(), Some(JobEvent::Metrics { metrics }) if metrics[0].value.is_none()));
            assert!(events[2].content().is_none());
        }
    }

    #[test]
    fn malformed_streams_are_errors() {
        for text in ["data: {\n\n", "id: x\n", "\u{fffd}data"] {
            let mut bytes = text.as_bytes().to_vec();
            if text.starts_with('\u{fffd}') {
                bytes = vec![0xff, b'\n'];
            }
            assert!(SseParser::default().push(&bytes, &mut VecDeque::new()).is_none(), "{text}");
        }
    }
}
