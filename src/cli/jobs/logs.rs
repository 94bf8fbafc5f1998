//! `qedgix jobs logs`: the output of a job's workers.

use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use serde_json::Value;

use super::reference::resolve;
use super::watch::Ended;
use crate::cli::client::Client;
use crate::cli::output::{Exit, errln, outln};
use crate::cli::rest::{items, text};
use crate::cli::signals::StopSignals;

/// Time between two requests with --follow. The server stores output about every second.
const POLL: Duration = Duration::from_millis(500);
/// Time after which a server that cannot be reached is given up.
const PATIENCE: Duration = Duration::from_secs(3600);

/// Flags of `jobs logs`.
#[derive(Args, Debug)]
pub struct LogsArgs {
    /// Id of the job, the beginning of it, or a name
    job: String,
    /// Print output as it comes, until the job ends
    #[arg(short, long)]
    follow: bool,
    /// Only the output of this attempt
    #[arg(long, value_name = "NUMBER")]
    attempt: Option<u64>,
}

/// Runs the command.
pub(super) async fn run(client: &Client, args: LogsArgs, print_json: bool) -> anyhow::Result<()> {
    let id = resolve(client, &args.job).await?;
    if !args.follow {
        let mut response = client.get(&format!("/v1/jobs/{id}/logs")).await?;
        if let (Some(only), Some(attempts)) = (args.attempt, response["attempts"].as_array_mut()) {
            attempts.retain(|attempt| attempt["attempt"] == only);
        }
        if print_json {
            outln!("{response:#}")?;
            return Ok(());
        }
        return Printed::default().print(&response, None);
    }
    let mut signals = StopSignals::new()?;
    tokio::select! {
        followed = follow(client, &id, args.attempt) => followed,
        code = signals.next() => Err(Exit::new(code, "").into()),
    }
}

/// Prints the output until the job has ended.
async fn follow(client: &Client, id: &str, only: Option<u64>) -> anyhow::Result<()> {
    let (mut printed, mut lost) = (Printed::default(), None::<Instant>);
    loop {
        // The state first: what the worker wrote before the end is in the logs that are read after it.
        let looked = async {
            let job = client.get(&format!("/v1/jobs/{id}")).await?;
            Ok((job, client.get(&format!("/v1/jobs/{id}/logs")).await?))
        };
        match looked.await {
            Ok((job, logs)) => {
                lost = None;
                printed.print(&logs, only)?;
                if Ended::of(&job).is_some() {
                    return Ok(());
                }
            }
            Err(error) => {
                let error: crate::cli::client::ClientError = error;
                let temporary = error.is_temporary();
                let message = anyhow::Error::new(error);
                if !temporary || lost.is_some_and(|lost| lost.elapsed() > PATIENCE) {
                    return Err(message);
                }
                if lost.is_none() {
                    errln!("warning: {message:#}; it is tried again");
                }
                lost.get_or_insert_with(Instant::now);
            }
        }
        tokio::time::sleep(POLL).await;
    }
}

/// What was printed.
#[derive(Default)]
struct Printed {
    /// The attempt, and its output so far.
    last: Option<(u64, String)>,
    /// Text after the last line break.
    rest: String,
}

impl Printed {
    /// Prints what is new in a response.
    fn print(&mut self, response: &Value, only: Option<u64>) -> anyhow::Result<()> {
        for attempt in items(response, "attempts") {
            let number = attempt["attempt"].as_u64().context("the response of the server has no attempt")?;
            let before = self.last.as_ref().map_or(0, |(number, _)| *number);
            if number < before || only.is_some_and(|only| only != number) {
                continue;
            }
            if number > before {
                self.end_line()?;
                errln!("--- attempt {number}, started {}", text(&attempt["started_at"]));
                self.last = Some((number, String::new()));
            }
            let log = attempt["log"].as_str().unwrap_or_default();
            let (_, known) = self.last.as_mut().expect("set above");
            self.rest.push_str(unseen(known, log));
            log.clone_into(known);
            if let Some(end) = self.rest.rfind('\n') {
                outln!("{}", &self.rest[..end])?;
                self.rest.drain(..=end);
            }
            if !attempt["ended_at"].is_null() {
                self.end_line()?;
            }
        }
        Ok(())
    }

    /// Prints the last line, which has no line break.
    fn end_line(&mut self) -> anyhow::Result<()> {
        if !self.rest.is_empty() {
            outln!("{}", std::mem::take(&mut self.rest))?;
        }
        Ok(())
    }
}

/// What of `now` comes after `before`. The server keeps only the end of the output, so `now` may begin within `before`.
fn unseen<'a>(before: &str, now: &'a str) -> &'a str {
    /// Bytes that are taken as the same place when they are equal.
    const SAME: usize = 4096;
    if let Some(rest) = now.strip_prefix(before) {
        return rest;
    }
    let mut from = before.len().saturating_sub(SAME);
    while !before.is_char_boundary(from) {
        from += 1;
    }
    let tail = &before[from..];
    now.rfind(tail).map_or(now, |at| &now[at + tail.len()..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_is_printed_once() {
        assert_eq!(unseen("", "abc"), "abc");
        assert_eq!(unseen("abc", "abcdef"), "def");
        assert_eq!(unseen("abc", "abc"), "");
        // The beginning was dropped.
        let long = (0..3000).fold(String::new(), |text, i| text + &format!("line {i}\n"));
        let (before, now) = (&long[..20_000], &long[10_000..]);
        assert_eq!(unseen(before, now), &long[20_000..]);
        // More was written between two looks than the server keeps.
        assert_eq!(unseen("old", "entirely new"), "entirely new");
        assert_eq!(unseen(&"ä".repeat(5000), &"ä".repeat(6000)).len(), 2000);
    }
}
