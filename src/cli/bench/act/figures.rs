//! What was measured, and what is told of it.

use std::collections::BTreeMap;
use std::time::Duration;

use comfy_table::{CellAlignment, Table, presets};
use serde_json::{Value, json};

/// What clients noted.
#[derive(Debug, Default)]
pub(super) struct Samples {
    /// Of each answered call.
    pub(super) latencies: Vec<Duration>,
    /// Of calls that were due and could not be sent in time: how long they had waited.
    pub(super) unsent: Vec<Duration>,
    /// Failed calls by code.
    pub(super) errors: BTreeMap<String, u64>,
    /// Time in which all that happened.
    pub(super) elapsed: Duration,
}

impl Samples {
    /// Counts a failed call.
    pub(super) fn fail(&mut self, code: String) {
        *self.errors.entry(code).or_default() += 1;
    }

    /// Takes what another client noted in the same time.
    pub(super) fn merge(&mut self, other: Self) {
        self.latencies.extend(other.latencies);
        self.unsent.extend(other.unsent);
        for (code, count) in other.errors {
            *self.errors.entry(code).or_default() += count;
        }
    }

    /// Takes what was noted in a later round.
    pub(super) fn add(&mut self, later: Self) {
        self.elapsed += later.elapsed;
        self.merge(later);
    }
}

/// Figures of one side. Times are in microseconds.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Figures {
    /// Answered calls.
    pub(super) answers: u64,
    /// Calls that were due and never sent; their wait counts among the latencies.
    unsent: u64,
    throughput: f64,
    /// p50, p99, p99.9, the longest.
    times: [f64; 4],
    /// Failed calls by code.
    pub(super) errors: BTreeMap<String, u64>,
}

/// Quantiles told, with their names.
const QUANTILES: [(&str, f64); 4] = [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)];

impl Figures {
    /// Sums up.
    pub(super) fn of(samples: Samples) -> Self {
        let Samples { latencies, unsent, errors, elapsed } = samples;
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

/// The smallest time that at least a share `q` of all do not exceed; zero of none.
fn quantile(sorted: &[Duration], q: f64) -> Duration {
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or_default()
}

/// Act over echo; null where the echo has nothing to divide by.
pub(super) fn ratios(act: &Figures, echo: &Figures) -> Value {
    let of = |act: f64, echo: f64| if echo > 0.0 { json!(act / echo) } else { Value::Null };
    let [p50, p99, p999, _] = [0, 1, 2, 3].map(|i| of(act.times[i], echo.times[i]));
    json!({ "throughput": of(act.throughput, echo.throughput), "p50": p50, "p99": p99, "p999": p999 })
}

/// Both sides and their ratios.
pub(super) fn table(act: &Figures, echo: &Figures) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_header(["", "per second", "p50 µs", "p99 µs", "p99.9 µs", "max µs", "answers", "unsent", "errors"]);
    for (name, side) in [("echo", echo), ("Act", act)] {
        let mut row = vec![name.to_owned(), format!("{:.0}", side.throughput)];
        row.extend(side.times.map(|time| format!("{time:.0}")));
        row.extend([side.answers.to_string(), side.unsent.to_string(), list(&[&side.errors])]);
        table.add_row(row);
    }
    let of = |act: f64, echo: f64| if echo > 0.0 { format!("{:.2}", act / echo) } else { "-".to_owned() };
    let mut row = vec!["Act / echo".to_owned(), of(act.throughput, echo.throughput)];
    row.extend((0..QUANTILES.len()).map(|i| of(act.times[i], echo.times[i])));
    table.add_row(row);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// Errors by code, in a line.
pub(super) fn list(errors: &[&BTreeMap<String, u64>]) -> String {
    let told: Vec<String> = errors.iter().flat_map(|e| e.iter()).map(|(code, count)| format!("{code} {count}")).collect();
    if told.is_empty() { "0".to_owned() } else { told.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(micros: impl IntoIterator<Item = u64>) -> Samples {
        let latencies = micros.into_iter().map(Duration::from_micros).collect();
        Samples { latencies, elapsed: Duration::from_secs(2), ..Samples::default() }
    }

    #[test]
    fn quantiles_are_measured_times() {
        let figures = Figures::of(samples((1..=1000).rev()));
        assert_eq!(figures.times.map(f64::round), [500.0, 990.0, 999.0, 1000.0]);
        assert_eq!(figures.throughput, 500.0);
        assert_eq!(Figures::of(samples([7])).times.map(f64::round), [7.0; 4]);
        assert_eq!(Figures::of(Samples::default()).times, [0.0; 4]);
    }

    #[test]
    fn calls_that_were_never_sent_are_no_answers_but_count_as_waits() {
        let mut late = samples([10; 98]);
        late.unsent = vec![Duration::from_millis(1); 2];
        let figures = Figures::of(late);
        assert_eq!((figures.answers, figures.unsent), (98, 2));
        assert_eq!(figures.times[1].round(), 1000.0);
    }

    #[test]
    fn rounds_add_up_and_ratios_compare() {
        let mut all = samples([10, 20]);
        let mut later = samples([30]);
        later.fail("UNAVAILABLE".into());
        later.fail("UNAVAILABLE".into());
        all.add(later);
        let act = Figures::of(all);
        assert_eq!((act.answers, act.throughput, act.failed()), (3, 0.75, 2));
        assert_eq!(list(&[&act.errors]), "UNAVAILABLE 2");
        let ratio = ratios(&act, &Figures::of(samples([5, 5, 5])));
        assert_eq!(ratio["throughput"], json!(0.5));
        assert_eq!((ratio["p50"].as_f64().unwrap().round(), ratio["p99"].as_f64().unwrap().round()), (4.0, 6.0));
        assert_eq!(ratios(&act, &Figures::of(Samples::default()))["p50"], Value::Null);
        assert!(table(&act, &act).to_string().contains("UNAVAILABLE 2"));
    }
}
