//! `qedgix jobs list` and `show`: jobs as tables.

use clap::Args;
use jiff::Timestamp;
use serde_json::{Value, json};

use super::reference::{resolve, short};
use super::view::short_time;
use crate::cli::client::Client;
use crate::cli::output::outln;
use crate::cli::rest::{items, query, text};
use crate::cli::table::text_table;

/// Jobs of a page of the server.
const PAGE: usize = 1000;

/// The jobs that a command is about.
#[derive(Args, Clone, Debug, Default)]
pub struct Filter {
    /// Only jobs in this state: queued, running, paused, cancelled, succeeded or failed
    #[arg(long)]
    state: Option<String>,
    /// Only jobs of this kind
    #[arg(long)]
    kind: Option<String>,
    /// Only jobs with this algorithm
    #[arg(long)]
    algorithm: Option<String>,
    /// Only jobs with this name; with * at the end: jobs whose names begin like this
    #[arg(long)]
    name: Option<String>,
    /// Only jobs with this label, or, without VALUE, with this key; may be repeated: jobs with all of them
    #[arg(long, value_name = "KEY[=VALUE]")]
    label: Vec<String>,
    /// Only jobs that this job has made
    #[arg(long, value_name = "JOB")]
    parent: Option<String>,
    /// Only jobs submitted since then: a time, as 2026-01-31T00:00:00Z, or how long ago, as 90m or 7d
    #[arg(long, value_name = "TIME", value_parser = moment)]
    since: Option<Timestamp>,
    /// Only jobs submitted before then
    #[arg(long, value_name = "TIME", value_parser = moment)]
    until: Option<Timestamp>,
}

/// Flags of `jobs list`.
#[derive(Args, Debug)]
pub struct ListArgs {
    #[command(flatten)]
    filter: Filter,
    /// Order: created, name, best:METRIC or last:METRIC; with - before it in descending order [default: -created]
    #[arg(long, allow_hyphen_values = true)]
    sort: Option<String>,
    /// Metric to show, best value and last value; may be repeated
    #[arg(long, default_value = "eval/mean_aoi")]
    metric: Vec<String>,
    /// Maximum number of jobs
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    limit: u32,
}

/// A time, or how long ago it was.
fn moment(text: &str) -> Result<Timestamp, String> {
    if let Ok(time) = text.parse() {
        return Ok(time);
    }
    let ago: Option<jiff::Span> = text.parse().ok();
    let ago = ago.and_then(|span| span.to_duration(jiff::SpanRelativeTo::days_are_24_hours()).ok());
    let time = ago.and_then(|ago| Timestamp::now().checked_sub(ago.abs()).ok());
    time.ok_or_else(|| "expected a time, as 2026-01-31T00:00:00Z, or how long ago, as 90m or 7d".to_owned())
}

impl Filter {
    /// Whether it leaves all jobs.
    pub fn is_empty(&self) -> bool {
        let Self { state, kind, algorithm, name, label, parent, since, until } = self;
        let words = [state, kind, algorithm, name, parent];
        words.iter().all(|word| word.is_none()) && label.is_empty() && since.is_none() && until.is_none()
    }

    /// Its parameters of `GET /v1/jobs`.
    async fn parameters(&self, client: &Client) -> anyhow::Result<Vec<(&'static str, Option<String>)>> {
        let Self { state, kind, algorithm, name, label, parent, since, until } = self.clone();
        let parent = match parent {
            Some(parent) => Some(resolve(client, &parent).await?),
            None => None,
        };
        Ok(vec![
            ("state", state),
            ("kind", kind),
            ("algorithm", algorithm),
            ("name", name),
            ("labels", (!label.is_empty()).then(|| label.join(","))),
            ("parent", parent),
            ("created_after", since.map(|time| time.to_string())),
            ("created_before", until.map(|time| time.to_string())),
        ])
    }
}

/// At most `limit` summaries of the jobs of a filter, with these metrics.
///
/// # Errors
/// The server cannot be reached or refuses the filter.
pub async fn list(
    client: &Client,
    filter: &Filter,
    sort: Option<&str>,
    metrics: &[String],
    limit: usize,
) -> anyhow::Result<Vec<Value>> {
    let mut parameters = filter.parameters(client).await?;
    parameters.push(("sort", sort.map(str::to_owned)));
    parameters.push(("metrics", (!metrics.is_empty()).then(|| metrics.join(","))));
    let (mut jobs, mut token) = (Vec::new(), String::new());
    loop {
        let mut request = parameters.clone();
        request.push(("page_size", Some((limit - jobs.len()).min(PAGE).to_string())));
        request.push(("page_token", Some(token)));
        let mut page = client.get(&format!("/v1/jobs{}", query(&request))).await?;
        jobs.extend(page["jobs"].as_array_mut().map(std::mem::take).unwrap_or_default());
        token = String::from(page["next_page_token"].as_str().unwrap_or_default());
        if token.is_empty() || jobs.len() >= limit {
            jobs.truncate(limit);
            return Ok(jobs);
        }
    }
}

/// Runs `jobs list`.
pub(super) async fn run(client: &Client, args: ListArgs, print_json: bool) -> anyhow::Result<()> {
    let jobs = list(client, &args.filter, args.sort.as_deref(), &args.metric, args.limit as usize).await?;
    if print_json {
        outln!("{:#}", json!({"jobs": jobs}))?;
    } else {
        outln!("{}", table(&jobs, &args.metric, Timestamp::now()))?;
    }
    Ok(())
}

/// The jobs as a table.
fn table(jobs: &[Value], metrics: &[String], now: Timestamp) -> String {
    let ids: Vec<String> = jobs.iter().map(|job| text(&job["id"])).collect();
    let mut header: Vec<String> = ["job", "name", "state", "kind", "done"].map(str::to_owned).into();
    header.extend(metrics.iter().map(|name| format!("{name} best / last")));
    header.extend(["threads", "age", "why"].map(str::to_owned));
    let rows = jobs.iter().zip(short(&ids)).map(|(job, id)| {
        let mut row = vec![id, text(&job["name"]), state(job), kind(job), done(job)];
        row.extend(metrics.iter().map(|name| {
            let metric = &job["metrics"][name];
            match (metric["best"].as_f64(), metric["last"].as_f64()) {
                (Some(best), Some(last)) => format!("{best:.2} / {last:.2}"),
                _ => "-".to_owned(),
            }
        }));
        let created = job["created_at"].as_str().and_then(|at| at.parse::<Timestamp>().ok());
        let age = created.map(|at| short_time(u64::try_from(now.duration_since(at).as_secs()).unwrap_or(0)));
        row.extend([text(&job["threads"]), age.unwrap_or_else(|| "-".to_owned()), why(job)]);
        row
    });
    text_table(header, rows)
}

/// The state, and what is asked of the job.
pub(super) fn state(job: &Value) -> String {
    match job["wanted"].as_str() {
        Some(wanted) => format!("{}, {wanted} asked", text(&job["state"])),
        None => text(&job["state"]),
    }
}

fn kind(job: &Value) -> String {
    match (text(&job["kind"]), job["algorithm"].as_str()) {
        (kind, Some(algorithm)) => format!("{kind} {algorithm}"),
        (kind, None) => kind,
    }
}

fn done(job: &Value) -> String {
    let [step, steps] = ["step", "steps"].map(|name| job["progress"][name].as_u64().unwrap_or(0));
    (step.saturating_mul(100)).checked_div(steps).map_or_else(|| "-".to_owned(), |share| format!("{} %", share.min(100)))
}

/// Why the job waits, has failed or ended early.
fn why(job: &Value) -> String {
    const LONGEST: usize = 72;
    let reason = job["waiting"]["reason"].as_str().or(job["reason"].as_str()).unwrap_or("");
    let line = reason.lines().next().unwrap_or_default();
    if line.chars().count() <= LONGEST { line.to_owned() } else { line.chars().take(LONGEST).chain("...".chars()).collect() }
}

/// Runs `jobs show`.
pub(super) async fn show(client: &Client, reference: &str, print_json: bool) -> anyhow::Result<()> {
    let id = resolve(client, reference).await?;
    let job = client.get(&format!("/v1/jobs/{id}")).await?;
    if print_json {
        outln!("{job:#}")?;
        return Ok(());
    }
    let mut rows = Vec::new();
    for (field, value) in job.as_object().into_iter().flatten() {
        let empty = value.is_null() || value.as_object().is_some_and(serde_json::Map::is_empty);
        if !empty && !matches!(field.as_str(), "environment" | "training" | "metrics" | "progress" | "waiting") && value != "" {
            rows.push([field.clone(), text(value)]);
        }
    }
    rows.push(["progress".into(), format!("step {} of {}", job["progress"]["step"], job["progress"]["steps"])]);
    rows.extend(job["waiting"]["reason"].as_str().map(|reason| ["waiting".to_owned(), reason.to_owned()]));
    for (name, metric) in job["metrics"].as_object().into_iter().flatten() {
        let best =
            format!("best {} at step {}, last {}", text(&metric["best"]), text(&metric["best_step"]), text(&metric["last"]));
        rows.push([name.clone(), best]);
    }
    let checkpoints = client.get(&format!("/v1/jobs/{id}/checkpoints")).await?;
    for checkpoint in items(&checkpoints, "checkpoints") {
        let field = format!("{} checkpoint", text(&checkpoint["kind"]));
        rows.push([field, format!("{} from step {}", text(&checkpoint["id"]), checkpoint["step"])]);
    }
    for section in ["environment", "training"] {
        for (field, value) in job[section].as_object().into_iter().flatten() {
            rows.push([format!("{section}.{field}"), text(value)]);
        }
    }
    outln!("{}", text_table(["", ""], rows))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_a_row_per_job() {
        let jobs = [
            json!({
                "id": "01a202d1-93be-769e-80f7-75eef9496f12", "name": "n", "state": "running", "wanted": "cancel", "kind": "train",
                "algorithm": "qmix", "progress": {"step": 50, "steps": 100}, "threads": 2, "created_at": "2026-01-01T00:00:00Z",
                "metrics": {"loss": {"best": 1.0, "last": 2.5}}, "waiting": null, "reason": null,
            }),
            json!({"id": "01a202d1-93bf-769e-80f7-75eef9496f12", "state": "queued", "waiting": {"reason": "3 jobs before it"}}),
        ];
        let table = table(&jobs, &["loss".to_owned()], "2026-01-01T01:01:00Z".parse().unwrap());
        for cell in ["01a202d1-93be ", "running, cancel asked", "train qmix", "50 %", "1.00 / 2.50", "1h 1m", "3 jobs before it"]
        {
            assert!(table.contains(cell), "{cell}: {table}");
        }
    }

    #[test]
    fn times_are_moments_or_ages() {
        let day = Timestamp::now() - jiff::SignedDuration::from_hours(24);
        assert!((moment("1d").unwrap() - day).get_seconds().abs() < 60);
        assert_eq!(moment("2026-01-31T00:00:00Z").unwrap().to_string(), "2026-01-31T00:00:00Z");
        assert!(moment("yesterday").is_err());
    }
}
