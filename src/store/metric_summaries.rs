//! The best and the last value of each metric of a job. They are kept with every report, so that lists neither read nor sort the
//! metrics themselves.

use std::collections::BTreeMap;

use sqlx::SqliteConnection;

use super::{Result, Store};

/// The best and the last value of a metric of a job.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MetricSummary {
    /// The best finite value; `None`: no value was finite. See [`larger_is_better`].
    pub best: Option<f64>,
    /// Environment steps of the best value.
    pub best_step: Option<u64>,
    /// The value of the last step; `None`: it was not finite.
    pub last: Option<f64>,
    /// The last step with a value, in environment steps.
    pub last_step: u64,
}

/// Whether the best value of a metric is its largest; that of all others is their smallest.
pub fn larger_is_better(name: &str) -> bool {
    matches!(name, "env_steps_per_s" | "eval/coverage" | "eval/fairness" | "q_tot")
}

impl MetricSummary {
    /// The summary of one value.
    fn of(step: u64, value: f64) -> Self {
        let value = value.is_finite().then_some(value);
        Self { best: value, best_step: value.map(|_| step), last: value, last_step: step }
    }

    /// Adds a later summary of the metric `name`. The first of equal values is the best.
    fn add(&mut self, name: &str, next: &Self) {
        let better = match (self.best, next.best) {
            (Some(best), Some(next)) => {
                if larger_is_better(name) {
                    next > best
                } else {
                    next < best
                }
            }
            (None, Some(_)) => true,
            (_, None) => false,
        };
        if better {
            (self.best, self.best_step) = (next.best, next.best_step);
        }
        if next.last_step >= self.last_step {
            (self.last, self.last_step) = (next.last, next.last_step);
        }
    }
}

/// Adds reported metrics (name, step, value) to the summaries of a job. A value that is reported again after a crash is equal to the first, except for
/// measured speeds, whose best value remains.
pub(super) async fn summarize<'a>(
    db: &mut SqliteConnection,
    job: i64,
    metrics: impl Iterator<Item = (&'a str, u64, f64)>,
) -> Result<()> {
    let mut summaries: BTreeMap<&str, MetricSummary> = BTreeMap::new();
    for (name, step, value) in metrics {
        let next = MetricSummary::of(step, value);
        summaries.entry(name).and_modify(|summary| summary.add(name, &next)).or_insert(next);
    }
    for (name, mut summary) in summaries {
        let sql = "SELECT best, best_step, last, last_step FROM metric_summaries WHERE job = ? AND name = ?";
        let stored: Option<Row> = sqlx::query_as(sql).bind(job).bind(name).fetch_optional(&mut *db).await?;
        if let Some(stored) = stored {
            let next = summary;
            summary = stored.into();
            summary.add(name, &next);
        }
        let sql = "REPLACE INTO metric_summaries (job, name, best, best_step, last, last_step) VALUES (?, ?, ?, ?, ?, ?)";
        let MetricSummary { best, best_step, last, last_step } = summary;
        let insert = sqlx::query(sql).bind(job).bind(name).bind(best).bind(best_step.map(|step| step as i64));
        insert.bind(last).bind(last_step as i64).execute(&mut *db).await?;
    }
    Ok(())
}

type Row = (Option<f64>, Option<i64>, Option<f64>, i64);

impl From<Row> for MetricSummary {
    fn from((best, best_step, last, last_step): Row) -> Self {
        Self { best, best_step: best_step.map(|step| step as u64), last, last_step: last_step as u64 }
    }
}

impl Store {
    /// The summaries of the metrics `names` of these jobs, by row id and name.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn metric_summaries(&self, jobs: &[i64], names: &[String]) -> Result<BTreeMap<i64, Vec<(String, MetricSummary)>>> {
        let mut found = BTreeMap::<i64, Vec<_>>::new();
        if names.is_empty() {
            return Ok(found);
        }
        let sql = "SELECT m.job, m.name, m.best, m.best_step, m.last, m.last_step FROM json_each(?) j CROSS JOIN json_each(?) n
                   CROSS JOIN metric_summaries m ON m.job = j.value AND m.name = n.value";
        let [jobs, names] = [serde_json::Value::from(jobs), serde_json::Value::from(names)].map(|list| list.to_string());
        type NamedRow = (i64, String, Option<f64>, Option<i64>, Option<f64>, i64);
        let rows: Vec<NamedRow> = sqlx::query_as(sql).bind(jobs).bind(names).fetch_all(&self.read).await?;
        for (job, name, best, best_step, last, last_step) in rows {
            found.entry(job).or_default().push((name, (best, best_step, last, last_step).into()));
        }
        Ok(found)
    }

    /// Whether any job has a metric of this name.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn has_metric(&self, name: &str) -> Result<bool> {
        let sql = "SELECT 1 FROM metric_summaries WHERE name = ? LIMIT 1";
        Ok(sqlx::query(sql).bind(name).fetch_optional(&self.read).await?.is_some())
    }

    /// The summaries of the first `limit` metrics of a job, by name.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn job_metric_summaries(&self, job: i64, limit: u32) -> Result<Vec<(String, MetricSummary)>> {
        let sql = "SELECT name, best, best_step, last, last_step FROM metric_summaries WHERE job = ? ORDER BY name LIMIT ?";
        type NamedRow = (String, Option<f64>, Option<i64>, Option<f64>, i64);
        let rows: Vec<NamedRow> = sqlx::query_as(sql).bind(job).bind(limit).fetch_all(&self.read).await?;
        Ok(rows.into_iter().map(|(name, a, b, c, d)| (name, (a, b, c, d).into())).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(name: &str, values: &[(u64, f64)]) -> MetricSummary {
        let metric = |&(step, value): &(u64, f64)| MetricSummary::of(step, value);
        let mut all = metric(&values[0]);
        values[1..].iter().for_each(|value| all.add(name, &metric(value)));
        all
    }

    #[test]
    fn best_and_last_of_a_curve() {
        let aoi = summary("eval/mean_aoi", &[(0, 9.0), (10, f64::NAN), (20, 4.0), (30, 5.0), (40, 4.0)]);
        let expected = MetricSummary { best: Some(4.0), best_step: Some(20), last: Some(4.0), last_step: 40 };
        assert_eq!(aoi, expected);
        let coverage = summary("eval/coverage", &[(0, 0.5), (10, 0.75), (20, f64::INFINITY)]);
        assert_eq!(coverage, MetricSummary { best: Some(0.75), best_step: Some(10), last: None, last_step: 20 });
        // A step that was repeated after a crash.
        assert_eq!(summary("loss", &[(20, 1.0), (10, 2.0)]).last_step, 20);
        assert_eq!(summary("loss", &[(0, f64::NAN)]).best, None);
    }
}
