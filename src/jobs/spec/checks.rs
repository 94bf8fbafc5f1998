//! Checks of the fields that all kinds of jobs have.

use std::collections::BTreeMap;

use crate::invalid::{Invalid, count_in_range, in_range};
use crate::jobs::metric_names;
use crate::store::{EarlyStop, JobId, JobLimits};

/// Least and most memory of a job that can be asked for, in bytes: 1 MiB and 1 PiB.
pub(super) const MIN_MEMORY: u64 = 1 << 20;
pub(super) const MAX_MEMORY: u64 = 1 << 50;
/// Most jobs that a job comes after.
const MAX_AFTER: usize = 100;
/// Most seconds of a timeout or a back-off: a year.
const MAX_SECONDS: u64 = 366 * 24 * 3600;

pub(super) fn resolve_limits(
    max_attempts: Option<u32>,
    timeout: Option<u64>,
    backoff: Option<u64>,
) -> Result<JobLimits, Invalid> {
    let backoff = backoff.unwrap_or(0);
    in_range("max_attempts", max_attempts.unwrap_or(1), 1..=1000)?;
    in_range("timeout", timeout.unwrap_or(1), 1..=MAX_SECONDS)?;
    in_range("backoff", backoff, 0..=MAX_SECONDS)?;
    Ok(JobLimits { max_attempts, timeout, backoff, memory: None })
}

pub(super) fn resolve_dependencies(ids: Vec<String>) -> Result<Vec<JobId>, Invalid> {
    count_in_range("after", ids.len(), 0..=MAX_AFTER, "jobs")?;
    let mut jobs = Vec::new();
    for (i, id) in ids.iter().enumerate() {
        let job = JobId::parse(id).ok_or_else(|| Invalid::new(format!("after[{i}]"), format!("{id:?}"), "the id of a job"))?;
        if jobs.contains(&job) {
            return Err(Invalid::new(format!("after[{i}]"), id, "each job once"));
        }
        jobs.push(job);
    }
    Ok(jobs)
}

pub(super) fn check_stop(stop: &EarlyStop) -> Result<(), Invalid> {
    let EarlyStop { metric, at_most, at_least, patience } = stop;
    if !metric_names::is_known(metric) {
        return Err(metric_names::unknown("stop.metric", metric, metric_names::all()));
    }
    for (field, limit) in [("stop.at_most", at_most), ("stop.at_least", at_least)] {
        if let Some(limit) = limit.filter(|limit| !limit.is_finite()) {
            return Err(Invalid::new(field, limit, "a finite number"));
        }
    }
    in_range("stop.patience", patience.unwrap_or(1), 1..=1_000_000)?;
    if at_most.is_none() && at_least.is_none() && patience.is_none() {
        return Err(Invalid::missing("stop.at_most", "at_most, at_least or patience"));
    }
    Ok(())
}

pub(super) fn check_priority(priority: i64) -> Result<(), Invalid> {
    in_range("priority", priority, -100..=100)
}

/// Most characters of the notes of a job.
pub const MAX_NOTES: usize = 4000;

pub(super) fn check_notes(notes: &str) -> Result<(), Invalid> {
    let control = |c: char| c.is_control() && !matches!(c, '\n' | '\t' | '\r');
    if notes.chars().count() > MAX_NOTES || notes.chars().any(control) {
        let expected = format!("at most {MAX_NOTES} characters without control characters other than line breaks and tabs");
        return Err(Invalid::new("notes", format!("{notes:?}"), expected));
    }
    Ok(())
}

/// Checks the name of a job or the key of a label.
///
/// # Errors
/// [`Invalid`] with `field`.
pub fn check_name(field: &str, name: &str) -> Result<(), Invalid> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if (1..=63).contains(&name.len()) && name.chars().all(allowed) && name.starts_with(|c: char| c.is_ascii_alphanumeric()) {
        return Ok(());
    }
    Err(Invalid::new(field, format!("{name:?}"), "1 to 63 letters, digits, '-', '_' or '.', starting with a letter or digit"))
}

pub(super) fn check_labels(labels: &BTreeMap<String, String>) -> Result<(), Invalid> {
    if labels.len() > 32 {
        return Err(Invalid::new("labels", format!("{} labels", labels.len()), "at most 32"));
    }
    for (key, value) in labels {
        check_name("labels", key)?;
        if value.chars().count() > 255 || value.chars().any(char::is_control) {
            let expected = "at most 255 characters without control characters";
            return Err(Invalid::new(format!("labels.{key}"), format!("{value:?}"), expected));
        }
    }
    Ok(())
}
