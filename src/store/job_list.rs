//! Lists of jobs: filtered, sorted, a page at a time. The statement of a list has only the conditions that its filter has, so that
//! each finds its rows by an index, in the order of the list.

use std::collections::{BTreeMap, HashMap};

use futures::TryStreamExt;
use jiff::Timestamp;
use serde_json::Value;
use sqlx::{QueryBuilder, Sqlite};

use super::jobs::JobRow;
use super::submission::text_of;
use super::{Job, JobId, JobKind, JobSpec, JobState, Result, Store, UnreadableSpec};
use crate::train_config::Algorithm;

/// The jobs that a list contains; what is absent does not restrict it.
#[derive(Clone, Debug, Default)]
pub struct JobFilter {
    /// Only those of this owner.
    pub owner: Option<String>,
    /// Only those in this state.
    pub state: Option<JobState>,
    /// Only those of this kind.
    pub kind: Option<JobKind>,
    /// Only those with this algorithm.
    pub algorithm: Option<Algorithm>,
    /// Only those that this job made.
    pub parent: Option<JobId>,
    /// Only those with this name; with `*` at the end: whose name begins like this.
    pub name: Option<String>,
    /// Only those with all of these labels; `None`: with any value.
    pub labels: BTreeMap<String, Option<String>>,
    /// Only those that were submitted at or after this time.
    pub created_after: Option<Timestamp>,
    /// Only those that were submitted before this time.
    pub created_before: Option<Timestamp>,
}

/// What a list is sorted by.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum JobSort {
    /// The time of submission.
    #[default]
    Created,
    /// The name.
    Name,
    /// The best value of this metric.
    Best(String),
    /// The last value of this metric.
    Last(String),
}

/// The order of a list. Jobs without a name or metric to sort by come last, the newest of them first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobOrder {
    /// What the list is sorted by. Jobs with equal names or values are in the order of submission.
    pub by: JobSort,
    /// From the largest to the smallest, or from the newest to the oldest.
    pub descending: bool,
}

impl Default for JobOrder {
    fn default() -> Self {
        Self { by: JobSort::Created, descending: true }
    }
}

/// The name or the value by which a job is sorted.
#[derive(Clone, Debug, PartialEq)]
pub enum SortKey {
    /// A name.
    Name(String),
    /// A value of a metric.
    Value(f64),
}

/// The last job of a page; the next page begins after it.
#[derive(Clone, Debug, PartialEq)]
pub struct JobCursor {
    /// The name or value of the job; `None`: it has none, or the list is sorted by time.
    pub key: Option<SortKey>,
    /// Row id of the job.
    pub row_id: i64,
}

/// A page of a list of jobs.
#[derive(Clone, Debug, Default)]
pub struct JobList {
    /// The jobs of the list.
    pub filter: JobFilter,
    /// The order.
    pub order: JobOrder,
    /// The end of the previous page.
    pub after: Option<JobCursor>,
    /// Maximum number of jobs.
    pub limit: usize,
    /// Maximum of the bytes of all summaries, unless the first job has more.
    pub max_bytes: usize,
}

/// A job of a list.
#[derive(Clone, Debug, PartialEq)]
pub struct ListedJob {
    /// The job.
    pub job: Job,
    /// Its specification; reading it takes time, so it is done once.
    pub spec: Result<JobSpec, UnreadableSpec>,
    /// The name or value by which it is sorted.
    pub key: Option<SortKey>,
}

/// A row of the sorted list: row id, name, value.
type Row = (i64, Option<String>, Option<f64>);

fn sort_key((row_id, name, value): Row) -> (i64, Option<SortKey>) {
    (row_id, name.map(SortKey::Name).or(value.map(SortKey::Value)))
}

impl Store {
    /// A page of jobs, and whether there are more.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn jobs(&self, list: &JobList) -> Result<(Vec<ListedJob>, bool)> {
        /// Bytes of a summary besides its texts.
        const FIXED: usize = 512;
        let mut db = self.read.begin().await?;
        let mut sorted: Vec<Row> = Vec::new();
        for &part in list.parts() {
            if sorted.len() <= list.limit {
                let mut statement = list.statement(part, list.limit + 1 - sorted.len());
                sorted.extend(statement.build_query_as::<Row>().fetch_all(&mut *db).await?);
            }
        }
        let more = sorted.len() > list.limit;
        sorted.truncate(list.limit);
        let numbers = Value::from(sorted.iter().map(|row| row.0).collect::<Vec<_>>()).to_string();
        // CROSS JOIN keeps the order of the list without sorting, which would read all documents first. The results of jobs, which
        // may be large, are not read.
        let sql = "SELECT j.number, j.id, j.owner, j.any_name, j.state, j.wanted, j.reason, j.notes, j.parent, j.spec, j.kind,
                   j.name, j.labels, j.threads, j.priority, j.algorithm, j.preset, j.seed, j.steps, j.attempts, j.failures,
                   j.consecutive_failures, j.step, j.policy, j.seq, j.blocked, j.not_before, j.ran, j.created_at,
                   j.started_at, j.ended_at
                   FROM json_each(?) w CROSS JOIN jobs j ON j.number = w.value";
        let (mut rows, mut jobs, mut bytes) = (sqlx::query_as(sql).bind(numbers).fetch(&mut *db), Vec::new(), 0);
        let mut keys: HashMap<i64, Option<SortKey>> = sorted.into_iter().map(sort_key).collect();
        while let Some(row) = rows.try_next().await? {
            let row: JobRow = row;
            let job = match Job::try_from(row) {
                Ok(job) => job,
                Err(error) => {
                    tracing::error!(%error, "a job is left out of a list");
                    continue;
                }
            };
            let spec = job.spec.decode();
            bytes += FIXED + job.notes.len() + job.spec.shown_bytes(spec.is_ok()) + job.reason.as_ref().map_or(0, String::len);
            if bytes > list.max_bytes && !jobs.is_empty() {
                return Ok((jobs, true));
            }
            jobs.push(ListedJob { key: keys.remove(&job.row_id).flatten(), spec, job });
        }
        Ok((jobs, more))
    }
}

/// A part of a list: the jobs with a name or metric to sort by come before those without.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    WithKey,
    WithoutKey,
}

impl JobList {
    /// The parts of the list from its cursor on.
    fn parts(&self) -> &'static [Part] {
        match (&self.order.by, &self.after) {
            (JobSort::Created, _) | (_, Some(JobCursor { key: None, .. })) => &[Part::WithoutKey],
            _ => &[Part::WithKey, Part::WithoutKey],
        }
    }

    /// The statement that returns the [`Row`]s of a part.
    fn statement(&self, part: Part, limit: usize) -> QueryBuilder<Sqlite> {
        let JobOrder { by, descending } = &self.order;
        let direction = if *descending { " DESC" } else { "" };
        let mut sql = QueryBuilder::new("SELECT");
        sql.push(" j.number, ");
        match (part, by) {
            (Part::WithKey, JobSort::Name) => {
                sql.push("j.name, NULL FROM jobs j INDEXED BY jobs_by_name WHERE j.name IS NOT NULL");
                self.push_key_cursor(&mut sql, "(j.name, j.number)");
                self.push_filter(&mut sql);
                sql.push(format_args!(" ORDER BY j.name{direction}, j.number{direction}"));
            }
            (Part::WithKey, JobSort::Best(metric) | JobSort::Last(metric)) => {
                let column = metric_column(by);
                sql.push(format_args!("NULL, m.{column} FROM metric_summaries m INDEXED BY metric_summaries_{column} "));
                sql.push("CROSS JOIN jobs j INDEXED BY jobs_by_number ON j.number = m.job WHERE m.name = ").push_bind(metric);
                sql.push(format_args!(" AND m.{column} IS NOT NULL"));
                self.push_key_cursor(&mut sql, &format!("(m.{column}, m.job)"));
                self.push_filter(&mut sql);
                sql.push(format_args!(" ORDER BY m.{column}{direction}, m.job{direction}"));
            }
            (Part::WithoutKey, _) | (_, JobSort::Created) => {
                // Jobs without a key are not sorted by it: the newest come first.
                let descending = *descending || *by != JobSort::Created;
                let (order, smallest) = if descending { (" DESC", "<") } else { ("", ">") };
                sql.push(format_args!("NULL, NULL FROM jobs j INDEXED BY {} WHERE j.number {smallest} ", self.index()));
                let start = if descending { i64::MAX } else { 0 };
                sql.push_bind(self.after.as_ref().filter(|after| after.key.is_none()).map_or(start, |after| after.row_id));
                match by {
                    JobSort::Created => {}
                    JobSort::Name => drop(sql.push(" AND j.name IS NULL")),
                    JobSort::Best(metric) | JobSort::Last(metric) => {
                        sql.push(" AND NOT EXISTS (SELECT 1 FROM metric_summaries m WHERE m.job = j.number AND m.name = ");
                        sql.push_bind(metric).push(format_args!(" AND m.{} IS NOT NULL)", metric_column(by)));
                    }
                }
                self.push_filter(&mut sql);
                sql.push(format_args!(" ORDER BY j.number{order}"));
            }
        }
        sql.push(" LIMIT ").push_bind(limit as i64);
        sql
    }

    /// The index that has the fewest rows of other lists, in the order of submission.
    fn index(&self) -> &'static str {
        let JobFilter { owner, state, parent, .. } = &self.filter;
        match (parent, state, owner) {
            (Some(_), ..) => "jobs_by_parent",
            (None, Some(_), _) => "jobs_by_state",
            (None, None, Some(_)) => "jobs_owner",
            (None, None, None) => "jobs_by_number",
        }
    }

    /// Skips the rows up to the cursor, in the order of `columns`.
    fn push_key_cursor(&self, sql: &mut QueryBuilder<Sqlite>, columns: &str) {
        let Some(JobCursor { key: Some(key), row_id }) = &self.after else { return };
        let comparison = if self.order.descending { "<" } else { ">" };
        sql.push(format_args!(" AND {columns} {comparison} ("));
        match key {
            SortKey::Name(name) => sql.push_bind(name.clone()),
            SortKey::Value(value) => sql.push_bind(*value),
        };
        sql.push(", ").push_bind(*row_id).push(")");
    }

    fn push_filter(&self, sql: &mut QueryBuilder<Sqlite>) {
        let filter = self.filter.clone();
        let texts = [
            ("owner", filter.owner),
            ("state", filter.state.map(|state| state.as_str().to_owned())),
            ("kind", filter.kind.map(|kind| kind.as_str().to_owned())),
            ("algorithm", filter.algorithm.as_ref().and_then(text_of)),
            ("parent", filter.parent.map(|parent| parent.to_string())),
        ];
        for (column, text) in texts {
            if let Some(text) = text {
                sql.push(format_args!(" AND j.{column} = ")).push_bind(text);
            }
        }
        if let Some(name) = filter.name {
            match name.strip_suffix('*') {
                None => drop(sql.push(" AND j.name = ").push_bind(name)),
                Some(prefix) => {
                    sql.push(" AND j.name >= ").push_bind(prefix.to_owned());
                    // Names are ASCII, so this is after every name with the prefix.
                    sql.push(" AND j.name < ").push_bind(format!("{prefix}\u{7f}"));
                }
            }
        }
        if let Some(after) = filter.created_after {
            sql.push(" AND j.created_at >= ").push_bind(after.as_millisecond());
        }
        if let Some(before) = filter.created_before {
            sql.push(" AND j.created_at < ").push_bind(before.as_millisecond());
        }
        for (key, value) in filter.labels {
            // A set that is computed once, not once per row.
            sql.push(" AND j.number IN (SELECT job FROM job_labels WHERE key = ").push_bind(key);
            if let Some(value) = value {
                sql.push(" AND value = ").push_bind(value);
            }
            sql.push(")");
        }
    }
}

/// The column of `metric_summaries` with the values to sort by.
fn metric_column(sort: &JobSort) -> &'static str {
    if matches!(sort, JobSort::Best(_)) { "best" } else { "last" }
}

#[cfg(test)]
mod tests {
    use sqlx::Row as _;

    use super::*;

    fn filters() -> Vec<JobFilter> {
        let none = JobFilter::default();
        let time = Some(Timestamp::UNIX_EPOCH);
        vec![
            none.clone(),
            JobFilter { owner: Some("o".into()), ..none.clone() },
            JobFilter { state: Some(JobState::Queued), ..none.clone() },
            JobFilter { kind: Some(JobKind::Train), ..none.clone() },
            JobFilter { algorithm: Some(Algorithm::Qmix), ..none.clone() },
            JobFilter { parent: JobId::parse("00000000-0000-0000-0000-000000000000"), ..none.clone() },
            JobFilter { name: Some("a".into()), ..none.clone() },
            JobFilter { name: Some("a*".into()), ..none.clone() },
            JobFilter { labels: [("a".into(), None), ("b".into(), Some("c".into()))].into(), ..none.clone() },
            JobFilter { created_after: time, created_before: time, ..none },
        ]
    }

    #[tokio::test]
    async fn every_list_reads_an_index_in_the_order_of_the_list() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let sorts = [JobSort::Created, JobSort::Name, JobSort::Best("loss".into()), JobSort::Last("loss".into())];
        for filter in filters() {
            for (by, descending) in sorts.iter().flat_map(|by| [(by.clone(), false), (by.clone(), true)]) {
                let list = JobList { filter: filter.clone(), order: JobOrder { by, descending }, ..JobList::default() };
                for &part in list.parts() {
                    let mut statement = list.statement(part, 1);
                    let plan = format!("EXPLAIN QUERY PLAN {}", statement.sql().as_str());
                    let mut plan = QueryBuilder::<Sqlite>::new(plan);
                    let steps = plan.build().fetch_all(&store.read).await.unwrap();
                    let steps: Vec<String> = steps.iter().map(|row| row.get("detail")).collect();
                    let slow = |step: &String| step.starts_with("SCAN") || step.contains("TEMP B-TREE");
                    assert!(!steps.iter().any(slow), "{list:?}: {steps:?}");
                    statement.build_query_as::<Row>().fetch_all(&store.read).await.unwrap();
                }
            }
        }
    }
}
