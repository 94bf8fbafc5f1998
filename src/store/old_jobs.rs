//! Jobs that ended long ago, which the rules of retention delete.

use jiff::Timestamp;

use super::{JobId, Result, Store, corrupt};

impl Store {
    /// The ids of jobs that ended, oldest first and at most `limit`: those beyond the newest `keep` (0: none), and those that ended
    /// before `before`. Jobs of a sweep go with it. A job stays while one that comes after it, or after one of its jobs, has not ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn old_jobs(&self, keep: usize, before: Option<Timestamp>, limit: u32) -> Result<Vec<JobId>> {
        let sql = "WITH ended AS (
                       SELECT j.id, j.number, j.ended_at, row_number() OVER (ORDER BY j.ended_at DESC, j.number DESC) AS place FROM jobs j
                       WHERE j.ended_at IS NOT NULL AND (j.parent IS NULL OR NOT EXISTS (SELECT 1 FROM jobs p WHERE p.id = j.parent)))
                   SELECT e.id FROM ended e
                   WHERE ((?1 > 0 AND e.place > ?1) OR e.ended_at < ?2)
                   AND NOT EXISTS (SELECT 1 FROM jobs c WHERE c.parent = e.id AND c.ended_at IS NULL)
                   AND NOT EXISTS (
                       SELECT 1 FROM job_dependencies d JOIN jobs w ON w.number = d.job
                       WHERE w.ended_at IS NULL
                       AND (d.needs = e.number OR d.needs IN (SELECT c.number FROM jobs c WHERE c.parent = e.id)))
                   ORDER BY e.ended_at, e.number LIMIT ?3";
        let query = sqlx::query_scalar(sql).bind(i64::try_from(keep).unwrap_or(i64::MAX));
        let query = query.bind(before.map(Timestamp::as_millisecond)).bind(limit);
        let ids: Vec<String> = query.fetch_all(&self.read).await?;
        ids.iter().map(|id| JobId::parse(id).ok_or_else(|| corrupt("job", id, "not an id"))).collect()
    }
}
