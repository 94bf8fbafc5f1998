//! Lists of jobs: what a caller may filter and sort by.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::view::{JobView, views};
use crate::invalid::{Invalid, in_range};
use crate::jobs::metric_names;
use crate::jobs::spec::check_name;
use crate::service::keys::Caller;
use crate::service::paging::{MAX_BYTES, parse_number};
use crate::service::{App, Error, Page, PageRequest};
use crate::serving::Owner;
use crate::store::{
    JobCursor, JobFilter, JobId, JobKind, JobList, JobOrder, JobSort, JobState, ListedJob, SortKey, is_metric_name,
};
use crate::train_config::Algorithm;

/// Most metrics that a list shows per job.
const MAX_METRICS: usize = 16;
/// Most labels that a list is filtered by.
const MAX_LABELS: usize = 8;

/// The list that a caller requests; an empty text is absent.
#[derive(Clone, Debug, Default)]
pub struct ListRequest {
    /// Only jobs in this state.
    pub state: Option<JobState>,
    /// Only jobs of this kind.
    pub kind: Option<JobKind>,
    /// Only jobs with this algorithm.
    pub algorithm: Option<Algorithm>,
    /// Only jobs with this name, or, with `*` at the end, whose name begins like this.
    pub name: String,
    /// Only jobs with all of these labels: `KEY=VALUE` or `KEY`, separated by commas.
    pub labels: String,
    /// Only jobs that the job with this id made.
    pub parent: String,
    /// Only jobs that were submitted at or after this time.
    pub created_after: Option<Timestamp>,
    /// Only jobs that were submitted before this time.
    pub created_before: Option<Timestamp>,
    /// `created`, `name`, `best:METRIC` or `last:METRIC`; after a `-`, in descending order. Default: `-created`.
    pub sort: String,
    /// Names of the metrics whose best and last values each job shows, separated by commas.
    pub metrics: String,
}

/// Summaries of the jobs that the caller sees.
///
/// # Errors
/// [`Error::Invalid`]: a field of the request, the page size is over 1000, or the token is invalid.
pub async fn list(app: &App, caller: &Caller, request: ListRequest, page: &PageRequest) -> Result<Page<JobView>, Error> {
    let limit = page.usual_limit()?;
    let order = parse_order(&request.sort)?;
    let metrics = parse_metrics(&request.metrics)?;
    for name in &metrics {
        check_exists(app, "metrics", name).await?;
    }
    if let JobSort::Best(name) | JobSort::Last(name) = &order.by {
        check_exists(app, "sort", name).await?;
    }
    let after = page.parse_token(|token| parse_cursor(&order.by, token))?;
    let mut filter = request.filter()?;
    filter.owner = caller.sees().and_then(Owner::id).map(str::to_owned);
    let list = JobList { filter, order, after, limit, max_bytes: MAX_BYTES };
    let (jobs, more) = app.store.jobs(&list).await?;
    let next_token = jobs.last().filter(|_| more).map(|last| cursor(&list.order.by, last)).unwrap_or_default();
    let items = views(app, jobs, &metrics).await?;
    Ok(Page { items, next_token })
}

impl ListRequest {
    fn filter(self) -> Result<JobFilter, Invalid> {
        let Self { state, kind, algorithm, name, labels, parent, created_after, created_before, .. } = self;
        if !name.is_empty() {
            check_name("name", name.strip_suffix('*').unwrap_or(&name))?;
        }
        let parent = Some(parent).filter(|parent| !parent.is_empty());
        let id = |parent: String| JobId::parse(&parent).ok_or_else(|| Invalid::new("parent", parent, "the id of a job"));
        Ok(JobFilter {
            owner: None,
            state,
            kind,
            algorithm,
            parent: parent.map(id).transpose()?,
            name: Some(name).filter(|name| !name.is_empty()),
            labels: parse_labels(&labels)?,
            created_after,
            created_before,
        })
    }
}

/// The items of a list in a text, separated by commas.
fn items(list: &str) -> impl Iterator<Item = &str> {
    list.split(',').filter(|_| !list.is_empty())
}

fn parse_labels(list: &str) -> Result<BTreeMap<String, Option<String>>, Invalid> {
    in_range("labels", items(list).count(), 0..=MAX_LABELS)?;
    let mut labels = BTreeMap::new();
    for item in items(list) {
        let (key, value) = item.split_once('=').map_or((item, None), |(key, value)| (key, Some(value.to_owned())));
        check_name("labels", key)?;
        if labels.insert(key.to_owned(), value).is_some() {
            return Err(Invalid::new("labels", format!("{key} twice"), "each label once"));
        }
    }
    Ok(labels)
}

fn parse_metrics(list: &str) -> Result<Vec<String>, Invalid> {
    in_range("metrics", items(list).count(), 0..=MAX_METRICS)?;
    items(list).map(|name| check_metric("metrics", name)).collect()
}

/// Checks that jobs report a metric of this name, or have done so under another version.
async fn check_exists(app: &App, field: &str, name: &str) -> Result<(), Error> {
    if metric_names::is_known(name) || app.store.has_metric(name).await? {
        return Ok(());
    }
    Err(metric_names::unknown(field, name, metric_names::all()).into())
}

fn check_metric(field: &str, name: &str) -> Result<String, Invalid> {
    let invalid = || Invalid::new(field, format!("{name:?}"), "names of metrics, such as eval/mean_aoi");
    is_metric_name(name).then(|| name.to_owned()).ok_or_else(invalid)
}

fn parse_order(sort: &str) -> Result<JobOrder, Invalid> {
    if sort.is_empty() {
        return Ok(JobOrder::default());
    }
    let key = sort.strip_prefix('-');
    let descending = key.is_some();
    let by = match key.unwrap_or(sort).split_once(':') {
        None if key.unwrap_or(sort) == "created" => JobSort::Created,
        None if key.unwrap_or(sort) == "name" => JobSort::Name,
        Some(("best", metric)) => JobSort::Best(check_metric("sort", metric)?),
        Some(("last", metric)) => JobSort::Last(check_metric("sort", metric)?),
        _ => {
            let expected = "created, name, best:METRIC or last:METRIC, and a - before it for descending order";
            return Err(Invalid::new("sort", format!("{sort:?}"), expected));
        }
    };
    Ok(JobOrder { by, descending })
}

/// The token of the page after a job: its row id, after the name or the bits of the value by which it is sorted.
fn cursor(by: &JobSort, last: &ListedJob) -> String {
    let key = match &last.key {
        _ if *by == JobSort::Created => return last.job.row_id.to_string(),
        None => String::new(),
        Some(SortKey::Name(name)) => name.clone(),
        Some(SortKey::Value(value)) => format!("{:016x}", value.to_bits()),
    };
    format!("{key}~{}", last.job.row_id)
}

fn parse_cursor(by: &JobSort, token: &str) -> Option<JobCursor> {
    if *by == JobSort::Created {
        return Some(JobCursor { key: None, row_id: parse_number(token)? });
    }
    let (key, row_id) = token.rsplit_once('~')?;
    let key = match by {
        _ if key.is_empty() => None,
        JobSort::Best(_) | JobSort::Last(_) => {
            let value = f64::from_bits(u64::from_str_radix(key, 16).ok()?);
            Some(Some(value).filter(|value| value.is_finite()).map(SortKey::Value)?)
        }
        _ => Some(SortKey::Name(key.to_owned())),
    };
    Some(JobCursor { key, row_id: parse_number(row_id)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_parsed() {
        let order = |sort: &str| parse_order(sort).map(|order| (order.by, order.descending));
        assert_eq!(order(""), Ok((JobSort::Created, true)));
        assert_eq!(order("created"), Ok((JobSort::Created, false)));
        assert_eq!(order("-best:eval/mean_aoi"), Ok((JobSort::Best("eval/mean_aoi".into()), true)));
        for wrong in ["age", "--name", "best", "best:", "worst:loss", "last:a b", "-", "name:x"] {
            assert_eq!(order(wrong).unwrap_err().field, "sort", "{wrong}");
        }
    }

    #[test]
    fn labels_are_parsed() {
        let labels = parse_labels("team=a=b,urgent,empty=").unwrap();
        assert_eq!(labels["team"].as_deref(), Some("a=b"));
        assert_eq!((&labels["urgent"], labels["empty"].as_deref()), (&None, Some("")));
        for wrong in [",", "=a", "a b=c", "a=1,a=2", "a,b,c,d,e,f,g,h,i"] {
            assert_eq!(parse_labels(wrong).unwrap_err().field, "labels", "{wrong}");
        }
    }

    #[test]
    fn tokens_belong_to_their_order() {
        let metric = JobSort::Best("loss".into());
        for (by, token) in [(&metric, "3ff8000000000000~7"), (&metric, "~7"), (&JobSort::Name, "a.b~7"), (&JobSort::Created, "7")]
        {
            assert_eq!(parse_cursor(by, token).map(|cursor| cursor.row_id), Some(7), "{token}");
        }
        for (by, token) in [(&metric, "7"), (&metric, "x~7"), (&metric, "7ff8000000000000~7"), (&JobSort::Created, "a~7")] {
            assert_eq!(parse_cursor(by, token), None, "{token}");
        }
    }
}
