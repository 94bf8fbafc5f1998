//! `qedgix policies`: manages the policies of a server over REST.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::{Args, Subcommand};
use indicatif::{HumanBytes, ProgressBar};
use serde_json::{Value, json};

use super::client::{Client, RestArgs};
use super::files::write_atomic;
use super::output::{errln, outln};
use super::rest::{self, items, query, text};
use super::{progress, table};
use crate::checkpoint::{Checkpoint, digest};
use crate::onnx;

/// Uploads of so many bytes show their progress.
const LARGE: u64 = 4 << 20;

/// Flags of `policies`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix policies list
  qedgix policies upload my-policy policy.safetensors --alias live
  qedgix policies alias set my-policy live 3 --expected 2      # only if live points to version 2
  qedgix policies history my-policy
  qedgix policies unload my-policy:1                            # open sessions continue
  qedgix policies versions my-policy
  qedgix policies delete my-policy:1
  qedgix policies export my-policy@live --out live.safetensors
  qedgix policies export my-policy@live --onnx live.onnx         # flies without a server
  qedgix policies list --server 192.0.2.7:8080 --json")]
pub struct PoliciesArgs {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    server: RestArgs,
    /// Print the response of the server as JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List all policies with their newest versions
    List,
    /// Show one policy
    Get {
        /// NAME, NAME@ALIAS or NAME:VERSION
        policy: String,
    },
    /// Publish a checkpoint as the next version of a policy
    Upload {
        /// Name of a new or existing policy
        name: String,
        /// Checkpoint file, as `qedgix train` writes it
        #[arg(required_unless_present = "checkpoint")]
        file: Option<PathBuf>,
        /// Id of a checkpoint of a training job, instead of a file
        #[arg(long, value_name = "ID", conflicts_with = "file")]
        checkpoint: Option<String>,
        /// Also point this alias to the new version [default: no alias]
        #[arg(long)]
        alias: Option<String>,
    },
    /// Write the checkpoint of a policy to a file
    Export {
        /// NAME, NAME@ALIAS or NAME:VERSION
        policy: String,
        /// Output file [default: NAME-VERSION.safetensors]
        #[arg(long, conflicts_with = "onnx")]
        out: Option<PathBuf>,
        /// Write an ONNX model instead, which flies without a server (docs/onboard.md)
        #[arg(long, value_name = "FILE")]
        onnx: Option<PathBuf>,
    },
    /// List the versions of a policy, newest first
    Versions {
        /// Name of the policy
        name: String,
        /// Maximum number of versions
        #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
    },
    /// Delete a version of a policy, or all of them; refused while an alias points to it or a session uses it
    Delete {
        /// NAME:VERSION, or NAME with --all-versions
        policy: String,
        /// Delete all versions
        #[arg(long)]
        all_versions: bool,
    },
    /// List, set and delete aliases
    #[command(subcommand)]
    Alias(Alias),
    /// Show the changes of the aliases of a policy, newest first
    History {
        /// Name of the policy
        name: String,
        /// Show only this alias [default: all aliases]
        #[arg(long)]
        alias: Option<String>,
        /// Maximum number of changes
        #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
    },
    /// Load all versions of a policy, or one
    Load {
        /// NAME or NAME:VERSION
        policy: String,
    },
    /// Unload all versions of a policy, or one; open sessions continue
    Unload {
        /// NAME or NAME:VERSION
        policy: String,
    },
}

#[derive(Debug, Subcommand)]
enum Alias {
    /// List the aliases of a policy
    List {
        /// Name of the policy
        name: String,
    },
    /// Point an alias to a version, for all requests at once
    Set {
        /// Name of the policy
        name: String,
        /// Name of the alias
        alias: String,
        /// Version that the alias points to
        version: u64,
        /// Fail unless the alias points to this version; 0: unless the alias is new [default: no check]
        #[arg(long, value_name = "VERSION")]
        expected: Option<u64>,
    },
    /// Delete an alias
    Delete {
        /// Name of the policy
        name: String,
        /// Name of the alias
        alias: String,
        /// Fail unless the alias points to this version [default: no check]
        #[arg(long, value_name = "VERSION")]
        expected: Option<u64>,
    },
}

/// Runs the command.
///
/// # Errors
/// The server cannot be reached or refuses the request, or a file cannot be read or written.
pub async fn run(args: PoliciesArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let (response, text) = match args.command {
        Command::List => list(&client).await?,
        Command::Get { policy } => details(client.get(&path(&[&policy])).await?),
        Command::Upload { name, file, checkpoint, alias } => {
            let url = path(&[&name, "versions"]) + &query(&[("alias", alias)]);
            details(match file {
                Some(file) => upload(&client, &url, &file).await?,
                None => client.post(&url, &json!({"checkpoint_id": checkpoint})).await?,
            })
        }
        Command::Export { policy, out, onnx } => export(&client, &policy, out, onnx).await?,
        Command::Versions { name, limit } => versions(&client, &name, limit).await?,
        Command::Delete { policy, all_versions } => delete(&client, &policy, all_versions).await?,
        Command::Alias(Alias::List { name }) => {
            let response = client.get(&path(&[&name, "aliases"])).await?;
            let rows = items(&response, "aliases").map(|a| [text(&a["alias"]), text(&a["version"])]);
            let table = table::text_table(["alias", "version"], rows);
            (response, table)
        }
        Command::Alias(Alias::Set { name, alias, version, expected }) => {
            let body = json!({"version": version, "expected": expected});
            let response = client.put(&path(&[&name, "aliases", &alias]), &body).await?;
            let before = match response["previous"].as_u64() {
                None => "new alias".to_owned(),
                Some(previous) if previous == version => "unchanged".to_owned(),
                Some(previous) => format!("previously {name}:{previous}"),
            };
            (response, format!("{name}@{alias} points to {name}:{version} ({before})"))
        }
        Command::Alias(Alias::Delete { name, alias, expected }) => {
            let url = path(&[&name, "aliases", &alias]) + &query(&[("expected", expected.map(|v| v.to_string()))]);
            (client.delete(&url).await?, format!("deleted {name}@{alias}"))
        }
        Command::History { name, alias, limit } => {
            let filter = query(&[("alias", alias), ("page_size", Some(limit.to_string()))]);
            let response = client.get(&(path(&[&name, "history"]) + &filter)).await?;
            let moves = items(&response, "history");
            let rows = moves.map(|m| ["at", "alias", "previous", "version", "by"].map(|field| text(&m[field])));
            let table = table::text_table(["at", "alias", "from", "to", "by"], rows);
            (response, table)
        }
        Command::Load { policy } => details(client.post(&path(&[&policy, "load"]), &Value::Null).await?),
        Command::Unload { policy } => details(client.post(&path(&[&policy, "unload"]), &Value::Null).await?),
    };
    if args.json {
        outln!("{response:#}")?;
    } else {
        outln!("{text}")?;
    }
    Ok(())
}

async fn list(client: &Client) -> anyhow::Result<(Value, String)> {
    let (mut all, mut next) = (Vec::new(), Some(String::new()));
    while let Some(token) = next {
        let mut page = client.get(&format!("/v1/policies{}", query(&[("page_token", Some(token))]))).await?;
        all.extend(page["policies"].as_array_mut().map(std::mem::take).unwrap_or_default());
        next = page["next_page_token"].as_str().filter(|token| !token.is_empty()).map(str::to_owned);
    }
    let rows = all.iter().map(|p| {
        let fleet = |size: &Value| if size.is_null() { "any".to_owned() } else { text(size) };
        let aoi = p["metrics"]["mean_aoi"].as_f64().map_or_else(|| "-".to_owned(), |aoi| format!("{aoi:.2}"));
        [
            text(&p["ref"]["name"]),
            text(&p["ref"]["version"]),
            kind(p).to_owned(),
            if p["loaded"] == true { "yes" } else { "no" }.to_owned(),
            text(&p["aliases"]),
            fleet(&p["uavs"]),
            fleet(&p["users"]),
            aoi,
        ]
    });
    let header = ["policy", "newest", "kind", "loaded", "aliases", "UAVs", "users", "mean AoI"];
    let table = table::text_table(header, rows);
    Ok((json!({"policies": all}), table))
}

async fn versions(client: &Client, name: &str, limit: u32) -> anyhow::Result<(Value, String)> {
    let filter = query(&[("page_size", Some(limit.to_string()))]);
    let response = client.get(&(path(&[name, "versions"]) + &filter)).await?;
    let rows = items(&response, "versions").map(|v| {
        let loaded = if v["loaded"] == true { "yes" } else { "no" };
        [text(&v["ref"]["version"]), loaded.to_owned(), text(&v["aliases"]), text(&v["ref"]["digest"])]
    });
    let table = table::text_table(["version", "loaded", "aliases", "digest"], rows);
    Ok((response, table))
}

async fn delete(client: &Client, policy: &str, all_versions: bool) -> anyhow::Result<(Value, String)> {
    let url = match (policy.split_once(':'), all_versions) {
        (Some((name, version)), false) => path(&[name, "versions", version]),
        (None, true) => path(&[policy]),
        (Some(_), true) => bail!("--all-versions needs NAME without a version"),
        (None, false) => bail!("expected NAME:VERSION; to delete all versions of {policy}, add --all-versions"),
    };
    Ok((client.delete(&url).await?, format!("deleted {policy}")))
}

/// A policy and a table of its fields.
fn details(policy: Value) -> (Value, String) {
    let reference = format!("{}:{}", text(&policy["ref"]["name"]), text(&policy["ref"]["version"]));
    let mut rows = vec![
        ["policy".to_owned(), reference],
        ["digest".to_owned(), text(&policy["ref"]["digest"])],
        ["kind".to_owned(), format!("{}. {}", kind(&policy), text(&policy["description"]))],
    ];
    for field in
        ["loaded", "aliases", "versions", "version_count", "loaded_versions", "headings", "detection_range", "created_at"]
    {
        rows.push([field.to_owned(), text(&policy[field])]);
    }
    for (metric, value) in policy["metrics"].as_object().into_iter().flatten() {
        rows.push([metric.clone(), text(value)]);
    }
    let table = table::text_table(["", ""], rows);
    (policy, table)
}

async fn export(client: &Client, policy: &str, out: Option<PathBuf>, onnx: Option<PathBuf>) -> anyhow::Result<(Value, String)> {
    // Resolves the version first, so that an alias that moves meanwhile does not change what is downloaded.
    let details = client.get(&path(&[policy])).await?;
    let (name, version) = (text(&details["ref"]["name"]), text(&details["ref"]["version"]));
    let bytes = client.download(&path(&[&format!("{name}:{version}"), "export"])).await?;
    let sha256 = digest(&bytes);
    ensure!(
        details["ref"]["digest"] == sha256.as_str(),
        "{policy}: the downloaded bytes do not have the digest of {name}:{version}"
    );
    let (out, bytes) = match onnx {
        None => (out.unwrap_or_else(|| format!("{name}-{version}.safetensors").into()), bytes),
        Some(file) => {
            let checkpoint = Checkpoint::from_bytes(&bytes).with_context(|| format!("{name}:{version}"))?;
            let model = onnx::export(&checkpoint, &format!("{name}:{version}"));
            (file, model.with_context(|| format!("{name}:{version} has no ONNX form"))?)
        }
    };
    write_atomic(&out, &bytes)?;
    let text = format!("wrote {name}:{version} ({} bytes) to {}", bytes.len(), out.display());
    Ok((json!({"policy": format!("{name}:{version}"), "digest": sha256, "file": out, "size": bytes.len()}), text))
}

/// Uploads a file. A large one has a progress bar, or, without a terminal, a line.
async fn upload(client: &Client, url: &str, file: &Path) -> anyhow::Result<Value> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    let size = bytes.len() as u64;
    let bar = if size < LARGE { ProgressBar::hidden() } else { progress::bytes_bar(size) };
    if size >= LARGE && bar.is_hidden() {
        errln!("uploading {} ({})", file.display(), HumanBytes(size));
    }
    let response = client.upload(url, bytes, &bar).await;
    bar.finish_and_clear();
    Ok(response?)
}

/// The path of a policy and resources below it.
fn path(segments: &[&str]) -> String {
    rest::path("policies", segments)
}

fn kind(policy: &Value) -> &'static str {
    if policy["kind"] == "POLICY_KIND_BASELINE" { "baseline" } else { "checkpoint" }
}
