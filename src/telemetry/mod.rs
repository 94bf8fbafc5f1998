//! Logs, traces and metrics of the process. Each is set up once per process, even with several servers in it.

mod filter;
mod lines;
mod metrics;
mod text_format;
mod traces;

use std::io::IsTerminal;

use tracing::{Level, Metadata};
use tracing_subscriber::filter::{LevelFilter, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, Registry, fmt};

pub use self::filter::InvalidFilter;
pub use self::lines::{LogGuard, dropped_log_lines};
pub use self::metrics::{install_metrics, render_metrics};
pub use self::traces::{InvalidEndpoint, TraceExporter};

/// Target of request spans and of log lines about failed requests.
const REQUESTS: &str = "qedgix::request";

/// Format and content of logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogConfig {
    /// One JSON object per line instead of text.
    pub json: bool,
    /// Log every request, not only failed ones.
    pub access: bool,
}

/// Whether logs have colours: on a terminal, unless NO_COLOR is set (no-color.org).
fn coloured() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// Writes logs to standard error, filtered by `QEDGIX_LOG` (default: `info`), and request spans to `traces`.
/// Further calls have no effect.
///
/// # Errors
/// The filter is not understood.
pub fn init_logs(config: LogConfig, traces: Option<&TraceExporter>) -> Result<LogGuard, InvalidFilter> {
    let filter = filter::from_env()?;
    // Target of the access log.
    let access = if config.access { "qedgix::access=info" } else { "qedgix::access=off" };
    let filter = filter.add_directive(access.parse().expect("the directive is valid"));
    // Log lines that cannot be written are lost; the default reports them with `eprintln!`, which would panic.
    let (queue, guard) = lines::queue();
    let lines = fmt::layer().with_writer(queue).log_internal_errors(false);
    let lines: Box<dyn Layer<Registry> + Send + Sync> = if config.json {
        lines.json().with_span_list(false).boxed()
    } else {
        lines.with_ansi(coloured()).fmt_fields(text_format::TextFields).boxed()
    };
    let installed = match traces {
        // One filter for the whole subscriber makes disabled log statements cheapest.
        None => tracing_subscriber::registry().with(lines).with(filter).try_init(),
        Some(traces) => {
            // Traces contain request spans and their warnings and errors.
            let traced = |m: &Metadata<'_>| m.target() == REQUESTS && (m.is_span() || *m.level() <= Level::WARN);
            let spans = traces.layer().with_filter(filter_fn(traced).with_max_level_hint(LevelFilter::DEBUG));
            tracing_subscriber::registry().with(lines.with_filter(filter)).with(spans).try_init()
        }
    };
    // Fails when a program that embeds this library has its own subscriber, which then stays.
    let _ = installed;
    Ok(guard)
}
