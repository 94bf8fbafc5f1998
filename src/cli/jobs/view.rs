//! What a watcher knows of a job: its state, its curve, its speed and the time left. No terminal.

use std::time::Duration;

use serde_json::Value;

use super::follow::{JobEvent, MetricRow};

/// The metric that is drawn.
const CURVE: &str = "eval/mean_aoi";
/// The metric of the speed.
const SPEED: &str = "env_steps_per_s";

/// A job that is followed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JobView {
    /// Its id.
    pub id: String,
    /// Its name; empty without one.
    pub name: String,
    /// Its state; empty if the server has not told.
    pub state: String,
    /// Why it is in this state.
    pub reason: Option<String>,
    /// The newest attempt.
    pub attempt: u64,
    /// Environment steps done.
    pub step: u64,
    /// Environment steps to do.
    pub steps: u64,
    /// Environment steps per second, from the last measurement.
    pub speed: Option<f64>,
    /// Step and mean AoI on the validation layouts, by step.
    pub curve: Vec<[f64; 2]>,
}

/// What is new after an event.
#[derive(Clone, Debug, PartialEq)]
pub enum News {
    /// The state.
    State,
    /// The evaluation at this step.
    Evaluation(u64, f64),
}

impl JobView {
    /// The job of a response of the server, without its events.
    pub fn new(job: &Value) -> Self {
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        Self {
            id: text(&job["id"]),
            name: text(&job["name"]),
            steps: job["progress"]["steps"].as_u64().unwrap_or(0),
            ..Self::default()
        }
    }

    /// Adds an event, and returns what of it is worth a line.
    pub fn apply(&mut self, event: JobEvent) -> Vec<News> {
        match event {
            JobEvent::State { state, attempt, reason } => {
                (self.state, self.attempt, self.reason) = (state, attempt, reason);
                if self.state != "running" {
                    self.speed = None;
                }
                vec![News::State]
            }
            JobEvent::Metrics { metrics } => metrics.into_iter().filter_map(|row| self.add(row)).collect(),
        }
    }

    fn add(&mut self, row: MetricRow) -> Option<News> {
        let value = row.value?;
        self.step = self.step.max(row.step);
        match row.name.as_str() {
            SPEED => self.speed = Some(value),
            CURVE => {
                let x = row.step as f64;
                let at = self.curve.partition_point(|point| point[0] < x);
                if self.curve.get(at).is_some_and(|point| point[0] == x) {
                    self.curve[at][1] = value;
                    return None;
                }
                self.curve.insert(at, [x, value]);
                return Some(News::Evaluation(row.step, value));
            }
            _ => {}
        }
        None
    }

    /// The evaluation with the lowest mean AoI.
    pub fn best(&self) -> Option<[f64; 2]> {
        self.curve.iter().copied().min_by(|a, b| a[1].total_cmp(&b[1]))
    }

    /// The values of the curve.
    pub fn values(&self) -> Vec<f64> {
        self.curve.iter().map(|point| point[1]).collect()
    }

    /// Time until the job has done all steps at its present speed.
    pub fn time_left(&self) -> Option<Duration> {
        let left = self.steps.saturating_sub(self.step) as f64;
        self.speed.filter(|speed| *speed > 0.0).and_then(|speed| Duration::try_from_secs_f64(left / speed).ok())
    }

    /// Share of the steps done, in per cent.
    pub fn per_cent(&self) -> u64 {
        (self.step.min(self.steps).saturating_mul(100)).checked_div(self.steps).unwrap_or(0)
    }

    /// `1234 steps/s, 12m 5s left`; empty without a speed.
    pub fn pace(&self) -> String {
        let Some(speed) = self.speed else { return String::new() };
        let left = self.time_left().map(|left| format!(", {} left", short_time(left.as_secs())));
        format!("{speed:.0} steps/s{}", left.unwrap_or_default())
    }
}

/// Seconds as people say them: the two largest units.
pub fn short_time(seconds: u64) -> String {
    let (minutes, hours, days) = (seconds / 60, seconds / 3600, seconds / 86_400);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds}s"),
        (0, 0, _) => format!("{minutes}m {}s", seconds % 60),
        (0, _, _) => format!("{hours}h {}m", minutes % 60),
        _ => format!("{days}d {}h", hours % 24),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn row(name: &str, step: u64, value: impl Into<Option<f64>>) -> MetricRow {
        MetricRow { name: name.into(), step, value: value.into() }
    }

    #[test]
    fn a_view_follows_events_of_resumed_jobs() {
        let mut view = JobView::new(&json!({"id": "x", "name": null, "progress": {"step": 7, "steps": 1000}}));
        let state = |state: &str| JobEvent::State { state: state.into(), attempt: 1, reason: None };
        assert_eq!(view.apply(state("running")), [News::State]);
        let rows = vec![row(CURVE, 0, 9.0), row(CURVE, 500, 3.0), row(SPEED, 500, 50.0), row("loss", 500, None)];
        assert_eq!(view.apply(JobEvent::Metrics { metrics: rows }), [News::Evaluation(0, 9.0), News::Evaluation(500, 3.0)]);
        assert_eq!((view.step, view.per_cent(), view.time_left()), (500, 50, Some(Duration::from_secs(10))));
        assert_eq!(view.pace(), "50 steps/s, 10s left");
        // A resumed attempt repeats a step and adds one before the last.
        let again = vec![row(CURVE, 500, 3.0), row(CURVE, 250, 5.0), row(SPEED, 250, 0.0)];
        assert_eq!(view.apply(JobEvent::Metrics { metrics: again }), [News::Evaluation(250, 5.0)]);
        assert_eq!((view.values(), view.best(), view.time_left()), (vec![9.0, 5.0, 3.0], Some([500.0, 3.0]), None));
        view.apply(state("failed"));
        assert!(view.state == "failed" && view.pace().is_empty());
    }

    #[test]
    fn times_have_two_units() {
        for (seconds, text) in [(0, "0s"), (59, "59s"), (61, "1m 1s"), (7200, "2h 0m"), (90_000, "1d 1h")] {
            assert_eq!(short_time(seconds), text);
        }
    }
}
