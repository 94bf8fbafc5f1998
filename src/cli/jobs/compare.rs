//! `qedgix jobs compare`: how jobs differ, what they reached, and their curves.
//!
//! Jobs whose configurations differ only in the seed are one group. Means over seeds have a 95 % interval of Student's t; the band of
//! a curve goes from the smallest to the largest value of its seeds.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};

use super::list::{Filter, list};
use super::reference::{resolve_all, short};
use crate::cli::client::Client;
use crate::cli::figures::FigureArgs;
use crate::cli::output::{errln, outln};
use crate::cli::rest::{items, query, text};
use crate::cli::table::text_table;
use crate::invalid::Invalid;
use crate::jobs::metric_names;
use crate::learner::MeanOverSeeds;
use crate::plot::{Chart, Series, lines};

/// Metrics whose best value is the largest.
const LARGEST: [&str; 4] = ["eval/coverage", "eval/fairness", "q_tot", "env_steps_per_s"];
/// Most metrics that a server shows of a job.
const SHOWN_METRICS: usize = 100;
/// Most jobs that are compared.
const MAX_JOBS: usize = 1000;

/// Flags of `jobs compare`.
#[derive(Args, Debug)]
pub struct CompareArgs {
    /// Ids of jobs, beginnings of ids, or names; a sweep or an experiment means its jobs
    #[arg(value_name = "JOB")]
    jobs: Vec<String>,
    #[command(flatten)]
    filter: Filter,
    /// Metric to compare
    #[arg(long, default_value = "eval/mean_aoi")]
    metric: String,
    /// File for the curves; in another format it has another extension
    #[arg(long, value_name = "FILE", default_value = "compare.svg")]
    svg: PathBuf,
    #[command(flatten)]
    figures: FigureArgs,
}

/// A job of the comparison.
#[derive(Debug, Serialize)]
struct Compared {
    id: String,
    name: Option<String>,
    /// Whether a sweep or an experiment made it, which numbers its name.
    #[serde(skip)]
    made: bool,
    state: String,
    seed: Option<u64>,
    /// Fields of the configuration that are not the same in all jobs, without the seed.
    differs: BTreeMap<String, Value>,
    best: Option<[f64; 2]>,
    last: Option<[f64; 2]>,
    #[serde(skip)]
    config: BTreeMap<String, Value>,
    /// (step, value), by step.
    #[serde(skip)]
    curve: Vec<[f64; 2]>,
}

/// Jobs whose configurations differ only in the seed.
#[derive(Debug, Serialize)]
struct Group {
    differs: BTreeMap<String, Value>,
    seeds: Vec<Option<u64>>,
    jobs: Vec<String>,
    best: Option<MeanOverSeeds>,
    last: Option<MeanOverSeeds>,
    #[serde(skip)]
    name: String,
    #[serde(skip)]
    curves: Vec<Vec<[f64; 2]>>,
}

/// Runs the command.
pub(super) async fn run(client: &Client, args: CompareArgs, print_json: bool) -> anyhow::Result<()> {
    args.figures.check_writable(&args.svg)?;
    let mut ids = resolve_all(client, &args.jobs).await?;
    if !args.filter.is_empty() {
        let found = list(client, &args.filter, None, &[], MAX_JOBS).await?;
        ids.extend(found.iter().map(|job| text(&job["id"])).filter(|id| !ids.contains(id)).collect::<Vec<_>>());
    }
    let ids = with_jobs_of_sweeps(client, ids).await?;
    if ids.is_empty() || ids.len() > MAX_JOBS {
        bail!("{} jobs; expected 1 to {MAX_JOBS}: ids, or a filter such as --label", ids.len());
    }
    let mut found = Vec::new();
    for id in &ids {
        found.push(client.get(&format!("/v1/jobs/{id}")).await?);
    }
    check_metric(&args.metric, &found)?;
    let mut jobs = Vec::new();
    for (id, job) in ids.iter().zip(&found) {
        jobs.push(compared(job, curve(client, id, &args.metric).await?, is_largest_best(&args.metric)));
    }
    let fields = mark_differences(&mut jobs);
    let groups = group(&jobs);
    args.figures.write(&args.svg, &lines(&chart(&args.metric, &groups)))?;
    let figures = args.figures.files(&args.svg);
    if print_json {
        outln!("{:#}", json!({"metric": args.metric, "jobs": jobs, "groups": groups, "figures": figures}))?;
        return Ok(());
    }
    outln!("{}", job_table(&args.metric, &fields, &jobs))?;
    if groups.len() < jobs.len() {
        outln!("Over seeds: mean and 95 % interval\n{}", group_table(&args.metric, &fields, &groups))?;
    }
    for figure in figures {
        errln!("curves: {}", figure.display());
    }
    Ok(())
}

/// Checks that one of the jobs has the metric, unless none of them has any yet.
fn check_metric(metric: &str, jobs: &[Value]) -> Result<(), Invalid> {
    let names: BTreeSet<&str> =
        jobs.iter().filter_map(|job| job["metrics"].as_object()).flat_map(|metrics| metrics.keys().map(String::as_str)).collect();
    // A job shows so many metrics, and may have more.
    if names.is_empty() || names.len() >= SHOWN_METRICS || names.contains(metric) {
        return Ok(());
    }
    Err(metric_names::unknown("--metric", metric, names))
}

/// The same ids, with the jobs of sweeps and experiments in place of these.
async fn with_jobs_of_sweeps(client: &Client, ids: Vec<String>) -> anyhow::Result<Vec<String>> {
    let mut all: Vec<String> = Vec::new();
    for id in ids {
        let path = format!(
            "/v1/jobs{}",
            query(&[("parent", Some(id.clone())), ("sort", Some("created".into())), ("page_size", Some("1000".into()))])
        );
        let made: Vec<String> = items(&client.get(&path).await?, "jobs").map(|job| text(&job["id"])).collect();
        let found = if made.is_empty() { vec![id] } else { made };
        all.extend(found.into_iter().filter(|id| !all.contains(id)).collect::<Vec<_>>());
    }
    Ok(all)
}

fn is_largest_best(metric: &str) -> bool {
    LARGEST.contains(&metric)
}

/// A metric of a job by step.
async fn curve(client: &Client, id: &str, metric: &str) -> anyhow::Result<Vec<[f64; 2]>> {
    let (mut points, mut token) = (Vec::new(), String::new());
    loop {
        let page = [("name", Some(metric.to_owned())), ("page_size", Some("100000".to_owned())), ("page_token", Some(token))];
        let page = client.get(&format!("/v1/jobs/{id}/metrics{}", query(&page))).await?;
        points.extend(items(&page, "metrics").filter_map(|row| Some([row["step"].as_u64()? as f64, row["value"].as_f64()?])));
        token = String::from(page["next_page_token"].as_str().unwrap_or_default());
        if token.is_empty() {
            return Ok(points);
        }
    }
}

fn compared(job: &Value, curve: Vec<[f64; 2]>, largest: bool) -> Compared {
    let mut config = BTreeMap::new();
    for field in ["kind", "algorithm", "preset"] {
        config.insert(field.to_owned(), job[field].clone());
    }
    for section in ["environment", "training"] {
        for (field, value) in job[section].as_object().into_iter().flatten() {
            config.insert(format!("{section}.{field}"), value.clone());
        }
    }
    let order = |a: &&[f64; 2], b: &&[f64; 2]| if largest { b[1].total_cmp(&a[1]) } else { a[1].total_cmp(&b[1]) };
    Compared {
        id: text(&job["id"]),
        name: job["name"].as_str().map(str::to_owned),
        made: !job["parent"].is_null(),
        state: text(&job["state"]),
        seed: job["seed"].as_u64(),
        differs: BTreeMap::new(),
        best: curve.iter().min_by(order).copied(),
        last: curve.last().copied(),
        config,
        curve,
    }
}

/// Fills in `differs` of each job and returns the fields.
fn mark_differences(jobs: &mut [Compared]) -> Vec<String> {
    let fields: BTreeSet<String> = jobs.iter().flat_map(|job| job.config.keys().cloned()).collect();
    let same = |field: &String| jobs.windows(2).all(|pair| pair[0].config.get(field) == pair[1].config.get(field));
    let different: Vec<String> = fields.into_iter().filter(|field| !same(field)).collect();
    for job in jobs {
        let value = |field: &String| (field.clone(), job.config.get(field).cloned().unwrap_or(Value::Null));
        job.differs = different.iter().map(value).collect();
    }
    different
}

fn group(jobs: &[Compared]) -> Vec<Group> {
    let mut groups: Vec<(&Compared, Vec<&Compared>)> = Vec::new();
    for job in jobs {
        match groups.iter_mut().find(|(first, _)| first.config == job.config) {
            Some((_, members)) => members.push(job),
            None => groups.push((job, vec![job])),
        }
    }
    let names = names(jobs, &groups);
    let of = |((first, members), name): ((&Compared, Vec<&Compared>), String)| {
        let values = |pick: fn(&Compared) -> Option<[f64; 2]>| -> Vec<f64> {
            members.iter().filter_map(|job| pick(job)).map(|point| point[1]).collect()
        };
        Group {
            differs: first.differs.clone(),
            seeds: members.iter().map(|job| job.seed).collect(),
            jobs: members.iter().map(|job| job.id.clone()).collect(),
            best: MeanOverSeeds::of(&values(|job| job.best)),
            last: MeanOverSeeds::of(&values(|job| job.last)),
            name,
            curves: members.iter().map(|job| job.curve.clone()).filter(|curve| !curve.is_empty()).collect(),
        }
    };
    groups.into_iter().zip(names).map(of).collect()
}

/// The names of groups in the legend, all different. A job is known by its own name or id; groups of several seeds, and the jobs of a
/// sweep, whose names are numbers, by what was varied.
fn names(jobs: &[Compared], groups: &[(&Compared, Vec<&Compared>)]) -> Vec<String> {
    let ids: Vec<String> = jobs.iter().map(|job| job.id.clone()).collect();
    let short_id = |job: &Compared| {
        let found = jobs.iter().position(|other| other.id == job.id).and_then(|at| short(&ids).into_iter().nth(at));
        found.unwrap_or_else(|| job.id.clone())
    };
    let configs: Vec<&BTreeMap<String, Value>> = groups.iter().map(|(first, _)| &first.differs).collect();
    let varied = independent(&configs);
    let by_values = groups.iter().all(|(_, members)| members.len() > 1 || members[0].made);
    let mut names: Vec<String> = Vec::new();
    for (first, members) in groups {
        let values = || {
            let values = varied.iter().map(|field| format!("{} {}", last_word(field), text(&first.differs[*field])));
            values.collect::<Vec<_>>().join(", ")
        };
        let own = first.name.clone().filter(|name| members.iter().all(|job| job.name.as_ref() == Some(name)));
        let name = if by_values && !varied.is_empty() {
            values()
        } else if let Some(own) = own {
            own
        } else if members.len() == 1 {
            short_id(first)
        } else if varied.is_empty() {
            text(&first.config["algorithm"])
        } else {
            values()
        };
        names.push(name);
    }
    // Several jobs may have one name.
    let twice: Vec<bool> = names.iter().map(|name| names.iter().filter(|other| *other == name).count() > 1).collect();
    for ((name, twice), (first, _)) in names.iter_mut().zip(twice).zip(groups) {
        if twice {
            *name = format!("{name} ({})", short_id(first));
        }
    }
    names
}

/// Fields that presets and algorithms set: they name a group only if nothing else does.
const DERIVED: [&str; 7] = ["mixer", "reward_scale", "teacher", "advice", "advice_margin", "memory", "eval_episodes"];

/// The fields that tell the groups apart, without those that follow from the fields before them, as the mixer from the algorithm.
fn independent<'a>(groups: &[&'a BTreeMap<String, Value>]) -> Vec<&'a str> {
    let Some(first) = groups.first() else { return Vec::new() };
    let mut fields: Vec<&str> = first.keys().map(String::as_str).collect();
    let rank = |field: &str| match field {
        "algorithm" => 0,
        "preset" => 1,
        _ if DERIVED.contains(&last_word(field)) => 4,
        _ if field.starts_with("training.") => 2,
        _ => 3,
    };
    fields.sort_by_key(|field| rank(field));
    let mut kept: Vec<&str> = Vec::new();
    for field in fields {
        let same = |field: &str, a: &BTreeMap<String, Value>, b: &BTreeMap<String, Value>| a.get(field) == b.get(field);
        let follows = groups
            .iter()
            .enumerate()
            .all(|(i, a)| groups[..i].iter().all(|b| same(field, a, b) || kept.iter().any(|kept| !same(kept, a, b))));
        if !follows {
            kept.push(field);
        }
    }
    kept
}

/// The last part of the path of a field.
fn last_word(field: &str) -> &str {
    field.rsplit('.').next().unwrap_or(field)
}

fn cell(value: Option<[f64; 2]>, index: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| if index == 0 { format!("{:.0}", value[0]) } else { format!("{:.2}", value[1]) })
}

fn job_table(metric: &str, fields: &[String], jobs: &[Compared]) -> String {
    let mut header: Vec<String> = ["job", "name", "state"].map(str::to_owned).into();
    header.extend(fields.iter().cloned());
    header.extend(["seed".to_owned(), format!("{metric}: best"), "at step".to_owned(), "last".to_owned()]);
    let ids: Vec<String> = jobs.iter().map(|job| job.id.clone()).collect();
    let rows = jobs.iter().zip(short(&ids)).map(|(job, id)| {
        let mut row = vec![id, job.name.clone().unwrap_or_else(|| "-".to_owned()), job.state.clone()];
        row.extend(fields.iter().map(|field| text(&job.differs[field])));
        row.push(job.seed.map_or_else(|| "-".to_owned(), |seed| seed.to_string()));
        row.extend([cell(job.best, 1), cell(job.best, 0), cell(job.last, 1)]);
        row
    });
    text_table(header, rows)
}

fn group_table(metric: &str, fields: &[String], groups: &[Group]) -> String {
    let mut header = fields.to_vec();
    header.extend(["seeds".to_owned(), format!("{metric}: best"), "95 %".to_owned(), "last".to_owned(), "95 %".to_owned()]);
    let cells = |mean: Option<MeanOverSeeds>| {
        let interval = mean.and_then(|mean| mean.interval).map(|[low, high]| format!("{low:.2} to {high:.2}"));
        [mean.map_or_else(|| "-".to_owned(), |mean| format!("{:.2}", mean.mean)), interval.unwrap_or_else(|| "-".to_owned())]
    };
    let rows = groups.iter().map(|group| {
        let mut row: Vec<String> = fields.iter().map(|field| text(&group.differs[field])).collect();
        row.push(group.seeds.len().to_string());
        row.extend(cells(group.best).into_iter().chain(cells(group.last)));
        row
    });
    text_table(header, rows)
}

/// The mean curve of each group over the steps that all its seeds reached.
fn chart(metric: &str, groups: &[Group]) -> Chart {
    let several = groups.iter().any(|group| group.curves.len() > 1);
    let series = groups.iter().map(|group| {
        let by_step: Vec<BTreeMap<u64, f64>> =
            group.curves.iter().map(|curve| curve.iter().map(|point| (point[0] as u64, point[1])).collect()).collect();
        let (mut points, mut band) = (Vec::new(), Vec::new());
        for &step in by_step.first().into_iter().flat_map(BTreeMap::keys) {
            let Some(values) = by_step.iter().map(|curve| curve.get(&step).copied()).collect::<Option<Vec<f64>>>() else {
                continue;
            };
            points.push([step as f64, values.iter().sum::<f64>() / values.len() as f64]);
            band.push(values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |band, &v| [band[0].min(v), band[1].max(v)]));
        }
        let several = by_step.len() > 1;
        let name = if several { format!("{}, {} seeds", group.name, by_step.len()) } else { group.name.clone() };
        Series { name, points, band: several.then_some(band) }
    });
    let unit = if metric.ends_with("_aoi") { " (slots)" } else { "" };
    Chart {
        title: metric.to_owned(),
        x: "environment steps".to_owned(),
        y: format!("{metric}{unit}"),
        series: series.collect(),
        note: if several { "Means over seeds, bands from the smallest to the largest.".to_owned() } else { String::new() },
        ..Chart::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(seed: u64, rate: f64, curve: &[[f64; 2]]) -> Compared {
        let job = json!({
            "id": format!("01a202d1-93be-769e-80f7-75eef949600{seed}"), "state": "succeeded", "seed": seed, "algorithm": "qmix",
            "training": {"learning_rate": rate, "steps": 100},
        });
        compared(&job, curve.to_vec(), false)
    }

    #[test]
    fn a_metric_that_no_job_has_is_refused() {
        let jobs = [json!({"metrics": {"eval/mean_aoi": {}, "loss": {}}}), json!({"metrics": {}})];
        assert!(check_metric("loss", &jobs).is_ok() && check_metric("los", &jobs[1..]).is_ok());
        let refused = check_metric("los", &jobs).unwrap_err().to_string();
        assert_eq!(refused, "--metric: got \"los\", expected one of eval/mean_aoi, loss; did you mean loss?");
    }

    #[test]
    fn jobs_that_differ_in_the_seed_are_one_group() {
        let mut jobs = vec![
            job(1, 0.1, &[[0.0, 9.0], [50.0, 1.0], [100.0, 4.0]]),
            job(2, 0.1, &[[0.0, 9.0], [50.0, 3.0]]),
            job(1, 0.2, &[[0.0, 8.0]]),
            job(2, 0.2, &[]),
        ];
        let fields = mark_differences(&mut jobs);
        assert_eq!(fields, ["training.learning_rate"]);
        assert_eq!((jobs[0].best, jobs[0].last), (Some([50.0, 1.0]), Some([100.0, 4.0])));
        let groups = group(&jobs);
        assert_eq!(groups.iter().map(|group| group.seeds.len()).collect::<Vec<_>>(), [2, 2]);
        let best = groups[0].best.unwrap();
        let [low, high] = best.interval.unwrap();
        assert!((best.mean - 2.0).abs() < 1e-12 && (low + 10.706).abs() < 1e-9 && (high - 14.706).abs() < 1e-9, "{best:?}");
        assert_eq!(groups[1].best, Some(MeanOverSeeds { mean: 8.0, interval: None }));
        let chart = chart("eval/mean_aoi", &groups);
        assert_eq!(chart.series[0].points, [[0.0, 9.0], [50.0, 2.0]]);
        assert_eq!(chart.series[0].band.as_ref().unwrap()[1], [1.0, 3.0]);
        assert!(chart.series[1].band.is_none());
        let table = group_table("eval/mean_aoi", &fields, &groups) + &job_table("eval/mean_aoi", &fields, &jobs);
        assert!(table.contains("-10.71 to 14.71") && table.contains("training.learning_rate"), "{table}");
    }

    /// A job of some name that differs in several fields, of a sweep if it has a parent.
    fn named(number: u64, name: Option<&str>, parent: Option<&str>, fields: &Value) -> Compared {
        let job = json!({
            "id": format!("01a202d1-93be-769e-80f7-75eef94960{number:02}"), "state": "succeeded", "seed": number, "name": name,
            "parent": parent, "algorithm": fields["algorithm"], "training": fields["training"],
        });
        compared(&job, Vec::new(), false)
    }

    fn legend(mut jobs: Vec<Compared>) -> Vec<String> {
        mark_differences(&mut jobs);
        group(&jobs).into_iter().map(|group| group.name).collect()
    }

    #[test]
    fn the_legend_says_what_differs() {
        let fields = |algorithm: &str, mixer: &str, rate: f64| json!({"algorithm": algorithm, "training": {"learning_rate": rate, "mixer": mixer, "steps": 30_000, "gamma": rate * 9.0}});
        let one = |number, name, rate| named(number, name, None, &fields("qmix", "invariant", rate));
        assert_eq!(legend(vec![one(1, Some("first"), 0.1), one(2, Some("second"), 0.2)]), ["first", "second"]);
        let same = legend(vec![one(1, Some("a"), 0.1), one(2, Some("a"), 0.2)]);
        assert!(same[0].starts_with("a (01a202d1") && same[0] != same[1], "{same:?}");
        let unnamed = legend(vec![one(1, None, 0.1), one(2, Some("b"), 0.2)]);
        assert!(unnamed[0].starts_with("01a202d1") && unnamed[1] == "b", "{unnamed:?}");
        // The mixer follows from the algorithm, and gamma here from the learning rate.
        let sweep = [("qmix", "invariant", 0.1), ("qmix", "invariant", 0.2), ("vdn", "vdn", 0.1), ("vdn", "vdn", 0.2)];
        let jobs = (0_u64..).zip(sweep).map(|(i, (algorithm, mixer, rate))| {
            named(i, Some(&format!("sweep-{i:03}")), Some("p"), &fields(algorithm, mixer, rate))
        });
        let expected =
            ["algorithm qmix, gamma 0.9", "algorithm qmix, gamma 1.8", "algorithm vdn, gamma 0.9", "algorithm vdn, gamma 1.8"];
        assert_eq!(legend(jobs.collect()), expected);
        let seeds = vec![one(1, Some("x"), 0.1), one(2, Some("y"), 0.1)];
        assert_eq!(legend(seeds), ["qmix"]);
    }
}
