//! Following a job until its end, with ctrl-c, and the exit status that tells how it ended.

use serde_json::Value;

use super::follow::{Followed, Follower};
use super::screen::Screen;
use crate::cli::client::Client;
use crate::cli::output::{Exit, errln, outln};
use crate::cli::signals::StopSignals;

/// Exit status of a command whose job failed.
pub const FAILED: u8 = 3;
/// Exit status of a command whose job was cancelled.
pub const CANCELLED: u8 = 4;

/// How a job that was followed ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Ended {
    /// It succeeded.
    Succeeded,
    /// It failed, for this reason.
    Failed(String),
    /// It was cancelled.
    Cancelled,
    /// It goes on; a signal with this exit status ended the watch.
    Left(u8),
}

/// What ctrl-c means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnSignal {
    /// The end of the watch.
    Leave,
    /// A question, if there is somebody to ask.
    Ask,
}

impl Ended {
    /// How this job has ended; `None` if it goes on.
    pub fn of(job: &Value) -> Option<Self> {
        match job["state"].as_str()? {
            "succeeded" => Some(Self::Succeeded),
            "failed" => Some(Self::Failed(job["reason"].as_str().unwrap_or("no reason given").to_owned())),
            "cancelled" => Some(Self::Cancelled),
            _ => None,
        }
    }

    /// The result of a command that followed the job.
    ///
    /// # Errors
    /// [`Exit`], unless the job succeeded.
    pub fn into_result(self, client: &Client, id: &str) -> anyhow::Result<()> {
        Err(match self {
            Self::Succeeded => return Ok(()),
            Self::Failed(reason) => Exit::new(FAILED, format!("error: job {id} failed: {reason}")),
            Self::Cancelled => Exit::new(CANCELLED, format!("job {id} was cancelled")),
            Self::Left(code) => {
                Exit::new(code, format!("the job goes on; to come back: qedgix jobs watch {id} --server {}", client.base()))
            }
        }
        .into())
    }
}

/// Follows the job of the screen until it ends or a signal ends the watch.
///
/// # Errors
/// The server refuses, could not be reached for an hour, or standard output cannot be written.
pub async fn follow(client: &Client, screen: &mut Screen, on_signal: OnSignal) -> anyhow::Result<Ended> {
    let id = screen.view.id.clone();
    let mut signals = StopSignals::new()?;
    let mut follower = Follower::new(client, &id, 0);
    let ended = loop {
        let followed = tokio::select! {
            followed = follower.next() => followed?,
            code = signals.next() => {
                if on_signal == OnSignal::Leave || !screen.is_interactive() {
                    break Ended::Left(code);
                }
                match ask(screen, &mut signals).await {
                    Answer::Leave => break Ended::Left(code),
                    Answer::Cancel => {
                        client.post(&format!("/v1/jobs/{id}/cancel"), &Value::Null).await?;
                    }
                    Answer::Watch => {}
                }
                continue;
            }
        };
        match followed {
            Followed::Event(event) => {
                if let Some(content) = event.content() {
                    screen.apply(content)?;
                }
            }
            Followed::Lost(error) => {
                screen.say(&format!("warning: {:#}; it is tried again, and the job goes on", anyhow::Error::new(error)));
            }
            Followed::Found => screen.say("the server responds again"),
            Followed::Ended => {
                let job = client.get(&format!("/v1/jobs/{id}")).await?;
                // A job that was retried at this moment goes on.
                if let Some(ended) = Ended::of(&job) {
                    break ended;
                }
            }
        }
    };
    screen.clear();
    Ok(ended)
}

/// Prints every event of a job as a line of JSON until it ends or a signal ends the watch.
///
/// # Errors
/// As [`follow`].
pub async fn print_events(client: &Client, id: &str) -> anyhow::Result<Ended> {
    let mut signals = StopSignals::new()?;
    let mut follower = Follower::new(client, id, 0);
    loop {
        let followed = tokio::select! {
            followed = follower.next() => followed?,
            code = signals.next() => return Ok(Ended::Left(code)),
        };
        match followed {
            Followed::Event(event) => {
                outln!("{}", serde_json::json!({"id": event.id, "event": event.event, "data": event.data}))?;
            }
            Followed::Lost(error) => errln!("warning: {:#}; it is tried again", anyhow::Error::new(error)),
            Followed::Found => {}
            Followed::Ended => {
                if let Some(ended) = Ended::of(&client.get(&format!("/v1/jobs/{id}")).await?) {
                    return Ok(ended);
                }
            }
        }
    }
}

enum Answer {
    Leave,
    Cancel,
    Watch,
}

/// Asks what to do with the job. Another signal, or no answer, leaves it.
async fn ask(screen: &mut Screen, signals: &mut StopSignals) -> Answer {
    screen.clear();
    errln!("The job runs on the server. l: leave it running; c: cancel it; w: go on watching. [l]");
    let line = tokio::task::spawn_blocking(|| {
        let mut line = String::new();
        std::io::stdin().read_line(&mut line).map(|_| line)
    });
    let answer = tokio::select! {
        line = line => line.ok().and_then(Result::ok).unwrap_or_default(),
        _ = signals.next() => String::new(),
    };
    match answer.trim() {
        "c" | "cancel" => {
            screen.draw();
            Answer::Cancel
        }
        "w" | "watch" => {
            screen.draw();
            Answer::Watch
        }
        _ => Answer::Leave,
    }
}
