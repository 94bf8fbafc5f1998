//! `qedgix policies`: the policies of a server, over REST.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::client::Client;
use super::connect::ConnectArgs;
use super::files::write_whole;
use super::table;
use crate::checkpoint::digest;

/// Flags of `policies`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix policies list
  qedgix policies upload my-policy policy.safetensors --alias live
  qedgix policies alias set my-policy live 3 --expected 2      # only if live means version 2 now
  qedgix policies history my-policy
  qedgix policies unload my-policy:1                            # sessions that fly it go on
  qedgix policies export my-policy@live --out live.safetensors
  qedgix policies list --server 192.0.2.7:8080 --json")]
pub struct PoliciesArgs {
    #[command(subcommand)]
    command: Command,
    /// The server's REST address
    #[arg(long, global = true, env = "QEDGIX_SERVER", default_value = "127.0.0.1:8080", value_name = "HOST:PORT")]
    server: String,
    #[command(flatten)]
    connect: ConnectArgs,
    /// Print the server's answer as JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// All policies, each in its newest version
    List,
    /// One policy: NAME, NAME@ALIAS or NAME:VERSION
    Get { policy: String },
    /// Publish a checkpoint as the next version of a policy
    Upload {
        /// Name of the policy, new or known
        name: String,
        /// A checkpoint, as `train` writes it
        #[arg(required_unless_present = "checkpoint")]
        file: Option<PathBuf>,
        /// A checkpoint of a training job of the server, by its id, instead of a file
        #[arg(long, value_name = "ID", conflicts_with = "file")]
        checkpoint: Option<String>,
        /// Let this alias mean it
        #[arg(long)]
        alias: Option<String>,
    },
    /// Write the checkpoint of a policy to a file
    Export {
        /// NAME, NAME@ALIAS or NAME:VERSION
        policy: String,
        /// Where to [default: NAME-VERSION.safetensors]
        #[arg(long)]
        out: Option<PathBuf>,
    },
    /// Names for versions that move
    #[command(subcommand)]
    Alias(Alias),
    /// Where the aliases of a policy have been, newest first
    History {
        /// Name of the policy
        name: String,
        /// Only this alias
        #[arg(long)]
        alias: Option<String>,
        /// At most this many moves
        #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
    },
    /// Load all versions of a policy (NAME) or one (NAME:VERSION)
    Load { policy: String },
    /// Unload all versions of a policy (NAME) or one (NAME:VERSION); sessions that fly them go on
    Unload { policy: String },
}

#[derive(Debug, Subcommand)]
enum Alias {
    /// Aliases of a policy
    List { name: String },
    /// Let NAME@ALIAS mean a version, for all requests at once
    Set {
        name: String,
        alias: String,
        version: u64,
        /// Only if it means this version now; 0: nothing
        #[arg(long, value_name = "VERSION")]
        expected: Option<u64>,
    },
    /// Delete an alias
    Delete {
        name: String,
        alias: String,
        /// Only if it means this version now
        #[arg(long, value_name = "VERSION")]
        expected: Option<u64>,
    },
}

/// Runs the command.
///
/// # Errors
/// The server cannot be reached or refuses, or a file cannot be read or written.
pub async fn run(args: PoliciesArgs) -> anyhow::Result<()> {
    let client = Client::new(&args.server, &args.connect)?;
    let (answer, text) = match args.command {
        Command::List => list(&client).await?,
        Command::Get { policy } => described(client.get(&at(&[&policy])).await?),
        Command::Upload { name, file, checkpoint, alias } => {
            let path = at(&[&name, "versions"]) + &query(&[("alias", alias)]);
            described(match file {
                Some(file) => client.upload(&path, read(&file)?).await?,
                None => client.post(&path, &json!({"checkpoint_id": checkpoint})).await?,
            })
        }
        Command::Export { policy, out } => export(&client, &policy, out).await?,
        Command::Alias(Alias::List { name }) => {
            let answer = client.get(&at(&[&name, "aliases"])).await?;
            let rows = items(&answer, "aliases").map(|a| [text(&a["alias"]), text(&a["version"])]);
            let table = table::of_rows(["alias", "version"], rows);
            (answer, table)
        }
        Command::Alias(Alias::Set { name, alias, version, expected }) => {
            let body = json!({"version": version, "expected": expected});
            let answer = client.put(&at(&[&name, "aliases", &alias]), &body).await?;
            let before = match answer["previous"].as_u64() {
                None => "new".to_owned(),
                Some(previous) if previous == version => "as before".to_owned(),
                Some(previous) => format!("before: {name}:{previous}"),
            };
            (answer, format!("{name}@{alias} is {name}:{version} ({before})"))
        }
        Command::Alias(Alias::Delete { name, alias, expected }) => {
            let path = at(&[&name, "aliases", &alias]) + &query(&[("expected", expected.map(|v| v.to_string()))]);
            (client.delete(&path).await?, format!("{name}@{alias} is deleted"))
        }
        Command::History { name, alias, limit } => {
            let filter = query(&[("alias", alias), ("page_size", Some(limit.to_string()))]);
            let answer = client.get(&(at(&[&name, "history"]) + &filter)).await?;
            let moves = items(&answer, "history");
            let rows = moves.map(|m| ["at", "alias", "previous", "version", "by"].map(|field| text(&m[field])));
            let table = table::of_rows(["at", "alias", "from", "to", "by"], rows);
            (answer, table)
        }
        Command::Load { policy } => described(client.post(&at(&[&policy, "load"]), &Value::Null).await?),
        Command::Unload { policy } => described(client.post(&at(&[&policy, "unload"]), &Value::Null).await?),
    };
    if args.json {
        println!("{answer:#}");
    } else {
        println!("{text}");
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
    let table = table::of_rows(header, rows);
    Ok((json!({"policies": all}), table))
}

/// A policy, and a line per field that says something.
fn described(policy: Value) -> (Value, String) {
    let reference = format!("{}:{}", text(&policy["ref"]["name"]), text(&policy["ref"]["version"]));
    let mut rows = vec![
        ["policy".to_owned(), reference],
        ["digest".to_owned(), text(&policy["ref"]["digest"])],
        ["kind".to_owned(), format!("{}. {}", kind(&policy), text(&policy["description"]))],
    ];
    for field in ["loaded", "aliases", "versions", "loaded_versions", "headings", "detection_range", "created_at"] {
        rows.push([field.to_owned(), text(&policy[field])]);
    }
    for (figure, value) in policy["metrics"].as_object().into_iter().flatten() {
        rows.push([figure.clone(), text(value)]);
    }
    let table = table::of_rows(["", ""], rows);
    (policy, table)
}

async fn export(client: &Client, policy: &str, out: Option<PathBuf>) -> anyhow::Result<(Value, String)> {
    // Which version it is now, so that the file has its name whatever moves meanwhile.
    let now = client.get(&at(&[policy])).await?;
    let (name, version) = (text(&now["ref"]["name"]), text(&now["ref"]["version"]));
    let bytes = client.download(&at(&[&format!("{name}:{version}"), "export"])).await?;
    let sha256 = digest(&bytes);
    ensure!(now["ref"]["digest"] == sha256.as_str(), "{policy}: what came has another digest than {name}:{version}");
    let out = out.unwrap_or_else(|| format!("{name}-{version}.safetensors").into());
    write_whole(&out, &bytes)?;
    let told = format!("{name}:{version}, {} bytes, is in {}", bytes.len(), out.display());
    Ok((json!({"policy": format!("{name}:{version}"), "digest": sha256, "file": out, "size": bytes.len()}), told))
}

fn read(file: &Path) -> anyhow::Result<Vec<u8>> {
    std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))
}

/// The path of a policy and what is below it; whatever a person types stays one segment.
fn at(segments: &[&str]) -> String {
    segments.iter().fold("/v1/policies".to_owned(), |path, segment| path + "/" + &escaped(segment))
}

fn query(parameters: &[(&str, Option<String>)]) -> String {
    let given = parameters.iter().filter_map(|(name, value)| Some(format!("{name}={}", escaped(value.as_deref()?))));
    let given: Vec<String> = given.collect();
    if given.is_empty() { String::new() } else { format!("?{}", given.join("&")) }
}

fn escaped(text: &str) -> String {
    use std::fmt::Write;
    text.bytes().fold(String::new(), |mut escaped, byte| {
        if byte.is_ascii_alphanumeric() || b"-_.:@".contains(&byte) {
            escaped.push(char::from(byte));
        } else {
            write!(escaped, "%{byte:02X}").expect("a String takes all that is written");
        }
        escaped
    })
}

fn items<'a>(answer: &'a Value, name: &str) -> impl Iterator<Item = &'a Value> {
    answer[name].as_array().into_iter().flatten()
}

fn kind(policy: &Value) -> &'static str {
    if policy["kind"] == "POLICY_KIND_BASELINE" { "baseline" } else { "checkpoint" }
}

/// A value as a person reads it.
fn text(value: &Value) -> String {
    match value {
        Value::Null => "-".to_owned(),
        Value::String(text) => text.clone(),
        Value::Array(items) if items.is_empty() => "-".to_owned(),
        Value::Array(items) => items.iter().map(text).collect::<Vec<_>>().join(", "),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_typed_stays_one_segment() {
        assert_eq!(at(&["my policy/..?x", "aliases", "live"]), "/v1/policies/my%20policy%2F..%3Fx/aliases/live");
        assert_eq!(at(&["mine:3"]), "/v1/policies/mine:3");
        assert_eq!(query(&[("alias", Some("a&b".into())), ("page_size", None)]), "?alias=a%26b");
        assert_eq!(query(&[("alias", None)]), "");
    }
}
