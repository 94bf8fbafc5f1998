//! `qedgix keys`: manages the API keys in a data directory. A server may run on it at the same time.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::{Args, Subcommand};
use comfy_table::{Table, presets};
use jiff::{Span, SpanRelativeTo, Timestamp};
use serde_json::json;

use super::output::{errln, outln};
use crate::service::keys::{self, CreatedKey, KeyInfo, NewKey, Purpose, Scopes};

/// Flags of `keys`.
#[derive(Args, Debug)]
#[command(
    after_help = "Scopes: read (lists, details, metrics), act (Act, sessions, environments, inference), jobs (submit, edit, cancel, \
                        pause, resume, retry, continue, delete), admin (policies and aliases, and everything above).

Once a data directory has a key, its server requires a key from every caller. A running server notices changes within about a
second.

Examples:
  qedgix keys create --name fleet --scopes read,act --expires 90d
  export QEDGIX_API_KEY=$(qedgix keys create --name me --scopes admin)
  qedgix keys create --name simulator --scopes act --rate 500 --burst 2000
  qedgix keys create --name dashboard --scopes read --owner ID   # sees what the key ID made
  qedgix keys list
  qedgix keys rotate ID --grace 1h       # a new key; the old one expires in an hour
  qedgix keys revoke ID"
)]
pub struct KeysArgs {
    /// Data directory of the server
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR", global = true)]
    data_dir: PathBuf,
    /// Print JSON instead of text
    #[arg(long, env = "QEDGIX_JSON", global = true)]
    json: bool,
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Create a key and print it. It is shown only once, because the server stores only its hash
    Create {
        /// Name for people, 1 to 128 bytes
        #[arg(long)]
        name: String,
        /// What the key allows: one or more of read, act, jobs and admin, separated by commas
        #[arg(long)]
        scopes: Scopes,
        /// Id of an existing key: the two share sessions, environments, jobs and policy names [default: the key has its own]
        #[arg(long, value_name = "ID")]
        owner: Option<String>,
        /// Time until the key expires, such as 12h, 90d or 52w [default: never]
        #[arg(long, value_parser = time, value_name = "TIME")]
        expires: Option<Duration>,
        /// Maximum requests per second [default: --key-rate of the server]
        #[arg(long, value_name = "PER_SECOND")]
        rate: Option<f64>,
        /// Maximum requests at once, after a pause [default: the requests of one second]
        #[arg(long, value_name = "REQUESTS", requires = "rate")]
        burst: Option<f64>,
    },
    /// List all keys, without their secrets
    List,
    /// Revoke a key; it stops working within about a second
    Revoke {
        /// Id of the key, or the whole key
        id: String,
    },
    /// Replace a key: create one with the same name, scopes, rate and lifetime, and let the old one expire
    Rotate {
        /// Id of the old key, or the whole key
        id: String,
        /// Time until the old key expires, such as 30m, 1h or 7d
        #[arg(long, value_parser = time, default_value = "0s", value_name = "TIME")]
        grace: Duration,
    },
}

/// Runs the command.
///
/// # Errors
/// The data directory has no database, a value is invalid, or the key is unknown.
pub async fn run(args: KeysArgs) -> anyhow::Result<()> {
    let purpose = match args.what {
        What::Create { .. } => Purpose::Create,
        What::Rotate { .. } | What::Revoke { .. } => Purpose::Change,
        What::List => Purpose::Read,
    };
    let store = keys::open_store(&args.data_dir, purpose).await?;
    let done = async {
        let now = Timestamp::now();
        match args.what {
            What::Create { name, scopes, owner, expires, rate, burst } => {
                let new = NewKey { name, scopes, owner, lifetime: expires, rate, burst };
                print_created(&keys::create(&store, new, now).await?, args.json)?;
            }
            What::Rotate { id, grace } => print_created(&keys::rotate(&store, &id, grace, now).await?, args.json)?,
            What::Revoke { id } => keys::revoke(&store, &id, now).await?,
            What::List => {
                let list = keys::list(&store, now).await?;
                if args.json {
                    outln!("{}", serde_json::to_string_pretty(&json!({"keys": list}))?)?;
                } else {
                    outln!("{}", table(&list))?;
                }
            }
        }
        anyhow::Ok(())
    };
    let done = done.await;
    // Without a server, the database is one file again.
    store.close().await;
    done
}

/// Prints the key alone to standard output, so that scripts can capture it, and everything else to standard error.
fn print_created(created: &CreatedKey, json: bool) -> anyhow::Result<()> {
    let CreatedKey { info, key } = created;
    let printed = if json {
        outln!(
            "{}",
            json!({"key": key, "id": info.id, "name": info.name, "scopes": info.scopes, "owner": info.owner, "expires_at": info.expires_at})
        )
    } else {
        let expiry = info.expires_at.map_or_else(|| "never expires".to_owned(), |at| format!("expires {}", minute(at)));
        errln!("API key {} ({}), scopes {}, {expiry}. It is shown only now:", info.id, info.name, info.scopes);
        outln!("{key}")
    };
    printed.with_context(|| format!("the API key {} exists and was not shown; revoke it", info.id))
}

fn table(list: &[KeyInfo]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_header(["id", "name", "scopes", "owner", "state", "rate", "created", "expires", "last used"]);
    let time = |at: Option<Timestamp>| at.map_or_else(|| "-".to_owned(), minute);
    for key in list {
        let rate = key.rate.map_or_else(|| "-".to_owned(), |rate| format!("{rate}/s"));
        let scopes = key.scopes.to_string();
        let (created, expires, used) = (time(Some(key.created_at)), time(key.expires_at), time(key.last_used_at));
        table.add_row([&key.id, &key.name, &scopes, &key.owner, key.state, &rate, &created, &expires, &used]);
    }
    table
}

fn minute(at: Timestamp) -> String {
    at.strftime("%Y-%m-%d %H:%M").to_string()
}

/// Parses a time with units; a day has 24 hours.
fn time(text: &str) -> Result<Duration, String> {
    let span = text.parse::<Span>().ok().and_then(|span| span.to_duration(SpanRelativeTo::days_are_24_hours()).ok());
    span.and_then(|time| Duration::try_from(time).ok())
        .ok_or_else(|| "expected a number with a unit, such as 12h, 90d or 52w".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_with_units_are_parsed() {
        const DAY: u64 = 24 * 3600;
        assert_eq!(time("90d"), Ok(Duration::from_secs(90 * DAY)));
        assert_eq!(time("2w"), Ok(Duration::from_secs(14 * DAY)));
        assert_eq!(time("1d 12h"), Ok(Duration::from_secs(DAY * 3 / 2)));
        for wrong in ["", "90", "soon", "-1d", "1y"] {
            assert!(time(wrong).is_err(), "{wrong}");
        }
    }
}
