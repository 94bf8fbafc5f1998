//! Figures over a job's steps. A row is (job, name, step): reporting it again replaces it, so that work done again after a
//! crash neither misses nor doubles a row.

use jiff::Timestamp;

use super::attempts::live;
use super::{JobId, Lease, Result, Store, timestamp};

/// A figure as a worker reports it.
#[derive(Clone, Debug, PartialEq)]
pub struct Metric {
    /// As `eval/mean_aoi`.
    pub name: String,
    /// Environment steps.
    pub step: u64,
    /// The figure; what is not finite is kept as unknown.
    pub value: f64,
}

/// A figure as it is kept.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricRow {
    /// As `eval/mean_aoi`.
    pub name: String,
    /// Environment steps.
    pub step: u64,
    /// Absent where it was not finite.
    pub value: Option<f64>,
    /// When it was reported.
    pub at: Timestamp,
}

/// The last row of a page; the next begins behind it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MetricCursor {
    /// Its name.
    pub name: String,
    /// Its step.
    pub step: u64,
}

impl Store {
    /// Commits metrics and progress together; false when the lease lasts no longer.
    ///
    /// # Errors
    /// The database.
    pub async fn report(&self, lease: Lease, metrics: &[Metric], step: u64, now: Timestamp) -> Result<bool> {
        let mut tx = self.write.begin().await?;
        if !live(&mut tx, lease).await? {
            return Ok(false);
        }
        let sql = "UPDATE jobs SET step = ?, seq = seq + 1 WHERE number = ? RETURNING seq";
        let seq: i64 = sqlx::query_scalar(sql).bind(step as i64).bind(lease.job).fetch_one(&mut *tx).await?;
        // What is told again as it was stays where it was told first.
        let sql = "INSERT INTO metrics (job, name, step, value, at, seq) VALUES (?, ?, ?, ?, ?, ?)
                   ON CONFLICT (job, name, step) DO UPDATE SET value = excluded.value, at = excluded.at, seq = excluded.seq
                   WHERE value IS NOT excluded.value";
        for metric in metrics {
            sqlx::query(sql)
                .bind(lease.job)
                .bind(&metric.name)
                .bind(metric.step as i64)
                .bind(metric.value.is_finite().then_some(metric.value))
                .bind(now.as_millisecond())
                .bind(seq)
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        self.ring(lease.job);
        Ok(true)
    }

    /// Metrics of a job by name and step: those called `name`, behind `after`, at most `limit`.
    ///
    /// # Errors
    /// The database.
    pub async fn metrics(
        &self,
        id: JobId,
        name: Option<&str>,
        after: Option<&MetricCursor>,
        limit: u32,
    ) -> Result<Vec<MetricRow>> {
        let sql = "SELECT m.name, m.step, m.value, m.at FROM metrics m JOIN jobs j ON j.number = m.job
                   WHERE j.id = ?1 AND (?2 IS NULL OR m.name = ?2) AND (?3 IS NULL OR (m.name, m.step) > (?3, ?4))
                   ORDER BY m.name, m.step LIMIT ?5";
        let rows: Vec<(String, i64, Option<f64>, i64)> = sqlx::query_as(sql)
            .bind(id.to_string())
            .bind(name)
            .bind(after.map(|a| a.name.as_str()))
            .bind(after.map(|a| a.step as i64))
            .bind(limit)
            .fetch_all(&self.read)
            .await?;
        rows.into_iter()
            .map(|(name, step, value, at)| Ok(MetricRow { name, step: step as u64, value, at: timestamp(at)? }))
            .collect()
    }
}
