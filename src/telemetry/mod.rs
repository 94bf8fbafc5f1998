//! Logs, traces and metrics of the process. All are set up once, however many servers it holds.

mod lines;
mod metrics;
mod traces;

use std::io::IsTerminal;

use tracing::{Level, Metadata};
use tracing_subscriber::filter::{LevelFilter, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, fmt};

pub use self::metrics::{metrics, render};
pub use self::traces::{BadEndpoint, Traces};

/// Target of the spans of requests and of what went wrong with them.
const REQUESTS: &str = "qedgix::request";

/// What is written about requests, and how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Logs {
    /// One JSON object per line instead of text.
    pub json: bool,
    /// A line for every request, however it went.
    pub access: bool,
}

/// Sends logs to standard error, filtered by `QEDGIX_LOG` (`info` when absent), and the spans of requests to `traces`.
/// Called twice, the first call counts.
pub fn logs(logs: Logs, traces: Option<&Traces>) {
    let filter = EnvFilter::try_from_env("QEDGIX_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    // The target of the line that is written about every request.
    let access = if logs.access { "qedgix::access=info" } else { "qedgix::access=off" };
    let filter = filter.add_directive(access.parse().expect("a directive"));
    let lines = fmt::layer().with_writer(std::io::stderr);
    let lines: Box<dyn Layer<Registry> + Send + Sync> = if logs.json {
        lines.json().with_span_list(false).boxed()
    } else {
        lines.with_ansi(std::io::stderr().is_terminal()).fmt_fields(lines::Fields).boxed()
    };
    let set = match traces {
        // One filter for all: what is off is found out without asking any layer.
        None => tracing_subscriber::registry().with(lines).with(filter).try_init(),
        Some(traces) => {
            // The spans of requests, and what went wrong in them.
            let wanted = |m: &Metadata<'_>| m.target() == REQUESTS && (m.is_span() || *m.level() <= Level::WARN);
            let spans = traces.layer().with_filter(filter_fn(wanted).with_max_level_hint(LevelFilter::DEBUG));
            tracing_subscriber::registry().with(lines.with_filter(filter)).with(spans).try_init()
        }
    };
    // A program that embeds this library may have set up its own.
    let _ = set;
}
