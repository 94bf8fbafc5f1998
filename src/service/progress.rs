//! How far a job has come, its speed, and the time that is left.

use crate::store::MetricRow;

pub(super) use crate::jobs::metric_names::SPEED;

/// How far a job had come when it reported metrics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Environment steps done.
    pub step: u64,
    /// Environment steps of the whole job.
    pub steps: u64,
    /// Environment steps per second at that time; `None`: not measured.
    pub steps_per_second: Option<f64>,
}

impl Progress {
    /// Progress after the rows of an event.
    pub(super) fn of(rows: &[MetricRow], steps: u64) -> Self {
        let step = rows.iter().map(|row| row.step).max().unwrap_or_default();
        let speed = rows.iter().filter(|row| row.name == SPEED).max_by_key(|row| row.step);
        Self { step, steps, steps_per_second: speed.and_then(|row| row.value) }
    }

    /// Seconds until all steps are done, at this speed.
    pub fn seconds_left(&self) -> Option<f64> {
        let speed = self.steps_per_second.filter(|speed| *speed > 0.0)?;
        Some(self.steps.saturating_sub(self.step) as f64 / speed)
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;

    #[test]
    fn the_time_left_follows_from_the_last_speed() {
        let row = |name: &str, step, value| MetricRow { name: name.into(), step, value: Some(value), at: Timestamp::UNIX_EPOCH };
        let rows = [row("loss", 400, 1.0), row(SPEED, 200, 10.0), row(SPEED, 400, 50.0)];
        let progress = Progress::of(&rows, 1000);
        assert_eq!(progress, Progress { step: 400, steps: 1000, steps_per_second: Some(50.0) });
        assert_eq!(progress.seconds_left(), Some(12.0));
        assert_eq!(Progress::of(&rows[..1], 1000).seconds_left(), None);
        assert_eq!(Progress { steps_per_second: Some(0.0), ..progress }.seconds_left(), None);
    }
}
