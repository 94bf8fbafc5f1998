//! Measured samples, and the metrics computed from them.

use std::collections::BTreeMap;
use std::time::Duration;

use comfy_table::{CellAlignment, Table, presets};
use serde_json::{Value, json};

/// Samples of the calls of one target.
#[derive(Debug, Default)]
pub(super) struct CallSamples {
    /// Latency of each answered call.
    pub(super) latencies: Vec<Duration>,
    /// Waiting time of each call that was due and not sent before the round ended.
    pub(super) unsent: Vec<Duration>,
    /// Failed calls by gRPC status code.
    pub(super) errors: BTreeMap<String, u64>,
    /// Measured time.
    pub(super) elapsed: Duration,
}

impl CallSamples {
    /// Counts a failed call.
    pub(super) fn fail(&mut self, code: String) {
        *self.errors.entry(code).or_default() += 1;
    }

    /// Adds samples of another client of the same round.
    pub(super) fn merge(&mut self, other: Self) {
        self.latencies.extend(other.latencies);
        self.unsent.extend(other.unsent);
        for (code, count) in other.errors {
            *self.errors.entry(code).or_default() += count;
        }
    }

    /// Adds samples of a later round.
    pub(super) fn append(&mut self, later: Self) {
        self.elapsed += later.elapsed;
        self.merge(later);
    }
}

/// Metrics of one target. Times are in microseconds.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CallMetrics {
    /// Answered calls.
    pub(super) answers: u64,
    /// Calls that were due and not sent; their waiting times count as latencies.
    unsent: u64,
    throughput: f64,
    /// Latencies: p50, p99, p99.9 and maximum.
    times: [f64; 4],
    /// Failed calls by gRPC status code.
    pub(super) errors: BTreeMap<String, u64>,
}

/// The reported quantiles.
const QUANTILES: [(&str, f64); 4] = [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)];

impl CallMetrics {
    /// Computes metrics from samples.
    pub(super) fn new(samples: CallSamples) -> Self {
        let CallSamples { latencies, unsent, errors, elapsed } = samples;
        let (answers, late) = (latencies.len() as u64, unsent.len() as u64);
        let mut times = latencies;
        times.extend(unsent);
        times.sort_unstable();
        let times = QUANTILES.map(|(_, q)| quantile(&times, q).as_secs_f64() * 1e6);
        let throughput = if elapsed.is_zero() { 0.0 } else { answers as f64 / elapsed.as_secs_f64() };
        Self { answers, unsent: late, throughput, times, errors }
    }

    /// Number of failed calls.
    pub(super) fn failed(&self) -> u64 {
        self.errors.values().sum()
    }

    pub(super) fn json(&self) -> Value {
        let [p50, p99, p999, max] = self.times;
        json!({
            "answers": self.answers,
            "unsent": self.unsent,
            "throughput_per_s": self.throughput,
            "p50_us": p50,
            "p99_us": p99,
            "p999_us": p999,
            "max_us": max,
            "errors": self.errors,
        })
    }
}

/// The smallest sample that at least a share `q` of all samples does not exceed; zero without samples.
fn quantile(sorted: &[Duration], q: f64) -> Duration {
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or_default()
}

/// Metrics of Act divided by those of the echo; null where the divisor is zero.
pub(super) fn ratios(act: &CallMetrics, echo: &CallMetrics) -> Value {
    let ratio = |act: f64, echo: f64| if echo > 0.0 { json!(act / echo) } else { Value::Null };
    let [p50, p99, p999, _] = [0, 1, 2, 3].map(|i| ratio(act.times[i], echo.times[i]));
    json!({ "throughput": ratio(act.throughput, echo.throughput), "p50": p50, "p99": p99, "p999": p999 })
}

/// A table of both targets and their ratios.
pub(super) fn table(act: &CallMetrics, echo: &CallMetrics) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_header(["", "per second", "p50 µs", "p99 µs", "p99.9 µs", "max µs", "answers", "unsent", "errors"]);
    for (name, target) in [("echo", echo), ("Act", act)] {
        let mut row = vec![name.to_owned(), format!("{:.0}", target.throughput)];
        row.extend(target.times.map(|time| format!("{time:.0}")));
        row.extend([target.answers.to_string(), target.unsent.to_string(), format_errors(&[&target.errors])]);
        table.add_row(row);
    }
    let ratio = |act: f64, echo: f64| if echo > 0.0 { format!("{:.2}", act / echo) } else { "-".to_owned() };
    let mut row = vec!["Act / echo".to_owned(), ratio(act.throughput, echo.throughput)];
    row.extend((0..QUANTILES.len()).map(|i| ratio(act.times[i], echo.times[i])));
    table.add_row(row);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// Failed calls by status code, as one line.
pub(super) fn format_errors(errors: &[&BTreeMap<String, u64>]) -> String {
    let parts: Vec<String> = errors.iter().flat_map(|e| e.iter()).map(|(code, count)| format!("{code} {count}")).collect();
    if parts.is_empty() { "0".to_owned() } else { parts.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(micros: impl IntoIterator<Item = u64>) -> CallSamples {
        let latencies = micros.into_iter().map(Duration::from_micros).collect();
        CallSamples { latencies, elapsed: Duration::from_secs(2), ..CallSamples::default() }
    }

    #[test]
    fn quantiles_are_samples() {
        let metrics = CallMetrics::new(samples((1..=1000).rev()));
        assert_eq!(metrics.times.map(f64::round), [500.0, 990.0, 999.0, 1000.0]);
        assert_eq!(metrics.throughput, 500.0);
        assert_eq!(CallMetrics::new(samples([7])).times.map(f64::round), [7.0; 4]);
        assert_eq!(CallMetrics::new(CallSamples::default()).times, [0.0; 4]);
    }

    #[test]
    fn unsent_calls_count_as_latencies_and_not_as_answers() {
        let mut late = samples([10; 98]);
        late.unsent = vec![Duration::from_millis(1); 2];
        let metrics = CallMetrics::new(late);
        assert_eq!((metrics.answers, metrics.unsent), (98, 2));
        assert_eq!(metrics.times[1].round(), 1000.0);
    }

    #[test]
    fn rounds_are_appended_and_ratios_compare_targets() {
        let mut all = samples([10, 20]);
        let mut later = samples([30]);
        later.fail("UNAVAILABLE".into());
        later.fail("UNAVAILABLE".into());
        all.append(later);
        let act = CallMetrics::new(all);
        assert_eq!((act.answers, act.throughput, act.failed()), (3, 0.75, 2));
        assert_eq!(format_errors(&[&act.errors]), "UNAVAILABLE 2");
        let compared = ratios(&act, &CallMetrics::new(samples([5, 5, 5])));
        assert_eq!(compared["throughput"], json!(0.5));
        assert_eq!((compared["p50"].as_f64().unwrap().round(), compared["p99"].as_f64().unwrap().round()), (4.0, 6.0));
        assert_eq!(ratios(&act, &CallMetrics::new(CallSamples::default()))["p50"], Value::Null);
        assert!(table(&act, &act).to_string().contains("UNAVAILABLE 2"));
    }
}
