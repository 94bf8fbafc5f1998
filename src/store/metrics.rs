//! Metrics of jobs, keyed by job, name and step. Reporting a key again replaces its value, so work that is repeated after a
//! crash neither loses nor duplicates a row.

use jiff::Timestamp;

use super::attempts::is_active;
use super::metric_summaries::summarize;
use super::{JobId, Lease, Result, Store, timestamp};

/// A metric as a worker reports it.
#[derive(Clone, Debug, PartialEq)]
pub struct Metric {
    /// Name, as `eval/mean_aoi`.
    pub name: String,
    /// Environment steps of training.
    pub step: u64,
    /// The value. Stored as NULL if it is not finite.
    pub value: f64,
}

/// A metric as stored.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricRow {
    /// Name, as `eval/mean_aoi`.
    pub name: String,
    /// Environment steps of training.
    pub step: u64,
    /// The value; `None` if it was not finite.
    pub value: Option<f64>,
    /// When this value was first reported.
    pub at: Timestamp,
}

/// The last row of a page; the next page begins after it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MetricCursor {
    /// Name of the row.
    pub name: String,
    /// Step of the row.
    pub step: u64,
}

/// Whether `name` is a valid name of a metric: 1 to 63 letters, digits, `_`, `-`, `/` and `.`.
pub fn is_metric_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '/' | '.');
    (1..=63).contains(&name.len()) && name.chars().all(allowed)
}

impl Store {
    /// Stores metrics and progress in one transaction. Returns false if the attempt has ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn report(&self, lease: Lease, metrics: &[Metric], step: u64, now: Timestamp) -> Result<bool> {
        let mut tx = self.begin().await?;
        if !is_active(&mut tx, lease).await? {
            tx.abandon().await?;
            return Ok(false);
        }
        let sql = "UPDATE jobs SET step = ?, seq = seq + 1 WHERE number = ? RETURNING seq";
        let seq: i64 = sqlx::query_scalar(sql).bind(step as i64).bind(lease.job_row).fetch_one(&mut *tx).await?;
        // A repeated value keeps the event of its first report.
        let sql = "INSERT INTO metrics (job, name, step, value, at, seq) VALUES (?, ?, ?, ?, ?, ?)
                   ON CONFLICT (job, name, step) DO UPDATE SET value = excluded.value, at = excluded.at, seq = excluded.seq
                   WHERE value IS NOT excluded.value";
        for metric in metrics {
            sqlx::query(sql)
                .bind(lease.job_row)
                .bind(&metric.name)
                .bind(metric.step as i64)
                .bind(metric.value.is_finite().then_some(metric.value))
                .bind(now.as_millisecond())
                .bind(seq)
                .execute(&mut *tx)
                .await?;
        }
        let rows = metrics.iter().map(|metric| (metric.name.as_str(), metric.step, metric.value));
        summarize(&mut tx, lease.job_row, rows).await?;
        tx.commit().await?;
        self.notify(lease.job_row);
        Ok(true)
    }

    /// At most `limit` metrics of a job by name and step: those called `name`, after `after`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn metrics(
        &self,
        id: JobId,
        name: Option<&str>,
        after: Option<&MetricCursor>,
        limit: u32,
    ) -> Result<Vec<MetricRow>> {
        // Two statements, so that each page begins where the last one ended. Names are not empty, steps not negative.
        let (after_name, after_step) = after.map_or(("", -1), |after| (after.name.as_str(), after.step as i64));
        let rows = sqlx::query_as::<_, (String, i64, Option<f64>, i64)>;
        let rows = match name {
            None => rows(
                "SELECT name, step, value, at FROM metrics WHERE job = (SELECT number FROM jobs WHERE id = ?1)
                 AND (name, step) > (?2, ?3) ORDER BY name, step LIMIT ?4",
            )
            .bind(id.to_string())
            .bind(after_name)
            .bind(after_step),
            Some(name) if name < after_name => return Ok(Vec::new()),
            Some(name) => rows(
                "SELECT name, step, value, at FROM metrics WHERE job = (SELECT number FROM jobs WHERE id = ?1)
                 AND name = ?2 AND step > ?3 ORDER BY name, step LIMIT ?4",
            )
            .bind(id.to_string())
            .bind(name)
            .bind(if name == after_name { after_step } else { -1 }),
        };
        let rows = rows.bind(limit).fetch_all(&self.read).await?;
        rows.into_iter()
            .map(|(name, step, value, at)| Ok(MetricRow { name, step: step as u64, value, at: timestamp(at)? }))
            .collect()
    }
}
