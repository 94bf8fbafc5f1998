//! When training ends before all steps are done.

use crate::store::{EarlyStop, larger_is_better};

/// Observes the metric of an [`EarlyStop`].
#[derive(Debug)]
pub(super) struct StopRule {
    rule: EarlyStop,
    /// The last step that was observed.
    last: Option<u64>,
    best: Option<f64>,
    /// Values since the best.
    since: u64,
}

impl StopRule {
    /// A rule that has observed `history`: the values, by step, that were reported before training resumed.
    pub(super) fn new(rule: EarlyStop, history: &[(u64, f64)]) -> Self {
        let mut stop = Self { rule, last: None, best: None, since: 0 };
        for &(step, value) in history {
            stop.observes(stop.rule.metric.clone().as_str(), step, value);
        }
        stop
    }

    /// Why training ends with this value; `None`: it goes on. A value that is reported again after training has resumed counts
    /// once.
    pub(super) fn observes(&mut self, name: &str, step: u64, value: f64) -> Option<String> {
        let EarlyStop { metric, at_most, at_least, patience } = &self.rule;
        if name != metric {
            return None;
        }
        if self.last.is_none_or(|last| step > last) {
            self.last = Some(step);
            let better = self.best.is_none_or(|best| if larger_is_better(metric) { value > best } else { value < best });
            if better && value.is_finite() {
                (self.best, self.since) = (Some(value), 0);
            } else {
                self.since += 1;
            }
        }
        let at_most = at_most.filter(|limit| value <= *limit).map(|limit| format!("is at most {limit}"));
        let at_least = at_least.filter(|limit| value >= *limit).map(|limit| format!("is at least {limit}"));
        let patience = patience.filter(|patience| self.since >= *patience).map(|patience| {
            let plural = if patience == 1 { "" } else { "s" };
            format!("was not better for {patience} value{plural}")
        });
        at_most.or(at_least).or(patience).map(|why| format!("stopped early: {metric} {why}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(metric: &str) -> EarlyStop {
        EarlyStop { metric: metric.into(), ..EarlyStop::default() }
    }

    #[test]
    fn limits_and_patience_end_training() {
        let mut stop = StopRule::new(EarlyStop { at_most: Some(5.0), ..rule("loss") }, &[]);
        let values = [("loss", 1, 6.0), ("q_tot", 1, 1.0), ("loss", 2, f64::NAN)];
        assert!(values.into_iter().all(|(name, step, value)| stop.observes(name, step, value).is_none()));
        assert_eq!(stop.observes("loss", 3, 5.0).as_deref(), Some("stopped early: loss is at most 5"));
        let mut stop = StopRule::new(EarlyStop { at_least: Some(0.5), ..rule("eval/coverage") }, &[]);
        assert_eq!(stop.observes("eval/coverage", 1, 0.4), None);
        assert_eq!(stop.observes("eval/coverage", 2, 0.5).as_deref(), Some("stopped early: eval/coverage is at least 0.5"));
        let mut stop = StopRule::new(EarlyStop { patience: Some(2), ..rule("eval/coverage") }, &[]);
        let values = [0.1, 0.3, 0.2, 0.3];
        let ends: Vec<_> = (1..).zip(values).map(|(step, value)| stop.observes("eval/coverage", step, value)).collect();
        let reason = "stopped early: eval/coverage was not better for 2 values".to_owned();
        assert_eq!(ends, [None, None, None, Some(reason)]);
    }

    #[test]
    fn a_resumed_run_ends_where_the_undisturbed_one_does() {
        let values = [(10, 3.0), (20, 2.0), (30, 2.5), (40, 2.0), (50, 9.0)];
        let limit = EarlyStop { patience: Some(2), ..rule("loss") };
        for resumed_at in 0..=4 {
            // The value at the step of the snapshot may be computed again.
            for first in [resumed_at.max(1) - 1, resumed_at] {
                let mut stop = StopRule::new(limit.clone(), &values[..resumed_at]);
                let end = values[first..].iter().find(|(step, value)| stop.observes("loss", *step, *value).is_some());
                assert_eq!(end.map(|(step, _)| *step), Some(if first == 4 { 50 } else { 40 }));
            }
        }
    }
}
