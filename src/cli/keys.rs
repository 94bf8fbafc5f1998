//! `qedgix keys`: API keys in a data directory, whether or not a server runs on it.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use comfy_table::{Table, presets};
use jiff::{Span, SpanRelativeTo, Timestamp};
use serde_json::json;

use crate::service::keys::{self, Created, KeyInfo, NewKey, Scopes};

/// Flags of `keys`.
#[derive(Args, Debug)]
#[command(
    after_help = "Scopes: read (lists, shows, metrics), act (acts, sessions, environments, inference), jobs (submit, cancel, pause, \
                        resume, delete), admin (policies, and all of these).

From the first key on a server asks every caller for one. A running server notices changes within a second or two.

Examples:
  qedgix keys create --name fleet --scopes read,act --expires 90d
  export QEDGIX_API_KEY=$(qedgix keys create --name me --scopes admin)
  qedgix keys create --name simulator --scopes act --rate 500 --burst 2000
  qedgix keys list
  qedgix keys rotate ID --grace 1h       # a new secret; the old one ends in an hour
  qedgix keys revoke ID"
)]
pub struct KeysArgs {
    /// The server's data directory
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR", global = true)]
    data_dir: PathBuf,
    /// Print JSON
    #[arg(long, env = "QEDGIX_JSON", global = true)]
    json: bool,
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Make a key and print it: once, it is kept nowhere
    Create {
        /// What you call it, to know it again
        #[arg(long)]
        name: String,
        /// What it opens, separated by commas: read, act, jobs, admin
        #[arg(long)]
        scopes: Scopes,
        /// How long it lasts: 12h, 90d, 52w [default: until it is revoked]
        #[arg(long, value_parser = time, value_name = "TIME")]
        expires: Option<Duration>,
        /// Most requests per second [default: the server's --key-rate]
        #[arg(long, value_name = "PER_SECOND")]
        rate: Option<f64>,
        /// Most of them at once [default: as many as one second allows]
        #[arg(long, value_name = "REQUESTS", requires = "rate")]
        burst: Option<f64>,
    },
    /// Tell of all keys, without their secrets
    List,
    /// End a key at once
    Revoke {
        /// Its id, or the whole key
        id: String,
    },
    /// Make a key like another one, which ends
    Rotate {
        /// The old one's id, or the whole key
        id: String,
        /// How long the old one still lasts
        #[arg(long, value_parser = time, default_value = "0s", value_name = "TIME")]
        grace: Duration,
    },
}

/// Runs the command.
///
/// # Errors
/// No data directory, values that cannot be used, an unknown key.
pub async fn run(args: KeysArgs) -> anyhow::Result<()> {
    let store = keys::open(&args.data_dir, matches!(args.what, What::Create { .. })).await?;
    let now = Timestamp::now();
    match args.what {
        What::Create { name, scopes, expires, rate, burst } => {
            let new = NewKey { name, scopes, lifetime: expires, rate, burst };
            show(&keys::create(&store, new, now).await?, args.json);
        }
        What::Rotate { id, grace } => show(&keys::rotate(&store, &id, grace, now).await?, args.json),
        What::Revoke { id } => keys::revoke(&store, &id, now).await?,
        What::List => {
            let list = keys::list(&store, now).await?;
            if args.json {
                println!("{}", serde_json::to_string_pretty(&json!({"keys": list}))?);
            } else {
                println!("{}", table(&list));
            }
        }
    }
    Ok(())
}

/// The key alone goes to standard output, so that a script can take it.
fn show(created: &Created, json: bool) {
    let Created { info, key } = created;
    if json {
        println!(
            "{}",
            json!({"key": key, "id": info.id, "name": info.name, "scopes": info.scopes, "expires_at": info.expires_at})
        );
        return;
    }
    let end = info.expires_at.map_or_else(|| "until it is revoked".to_owned(), |at| format!("until {}", minute(at)));
    eprintln!("{} ({}) opens {} {end}; it is shown this once:", info.name, info.id, info.scopes);
    println!("{key}");
}

fn table(list: &[KeyInfo]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_header(["id", "name", "scopes", "state", "rate", "created", "expires", "last used"]);
    let time = |at: Option<Timestamp>| at.map_or_else(|| "-".to_owned(), minute);
    for key in list {
        let rate = key.rate.map_or_else(|| "-".to_owned(), |rate| format!("{rate}/s"));
        let scopes = key.scopes.to_string();
        let (created, expires, used) = (time(Some(key.created_at)), time(key.expires_at), time(key.last_used_at));
        table.add_row([&key.id, &key.name, &scopes, key.state, &rate, &created, &expires, &used]);
    }
    table
}

fn minute(at: Timestamp) -> String {
    at.strftime("%Y-%m-%d %H:%M").to_string()
}

/// A time as people write it; a day has 24 hours.
fn time(text: &str) -> Result<Duration, String> {
    let span = text.parse::<Span>().ok().and_then(|span| span.to_duration(SpanRelativeTo::days_are_24_hours()).ok());
    span.and_then(|time| Duration::try_from(time).ok()).ok_or_else(|| "expected a number with a unit: 12h, 90d, 52w".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_as_people_write_them() {
        const DAY: u64 = 24 * 3600;
        assert_eq!(time("90d"), Ok(Duration::from_secs(90 * DAY)));
        assert_eq!(time("2w"), Ok(Duration::from_secs(14 * DAY)));
        assert_eq!(time("1d 12h"), Ok(Duration::from_secs(DAY * 3 / 2)));
        for wrong in ["", "90", "soon", "-1d", "1y"] {
            assert!(time(wrong).is_err(), "{wrong}");
        }
    }
}
