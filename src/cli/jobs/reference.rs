//! Names of jobs on the command line: an id, a unique beginning of an id, or the name of one job.

use anyhow::bail;

use crate::cli::client::Client;
use crate::cli::rest::{items, query, text};

/// Jobs that an error lists.
const LISTED: usize = 5;

/// The id of the job that `text` means.
///
/// # Errors
/// No job or several match, or the server refuses.
pub async fn resolve(client: &Client, reference: &str) -> anyhow::Result<String> {
    if let Ok(id) = uuid::Uuid::try_parse(reference) {
        return Ok(id.to_string());
    }
    let begins = is_beginning(reference).then(|| reference.to_ascii_lowercase());
    let mut found: Vec<[String; 3]> = Vec::new();
    let mut next = Some(String::new());
    while let Some(token) = next {
        let page =
            client.get(&format!("/v1/jobs{}", query(&[("page_size", Some("1000".into())), ("page_token", Some(token))]))).await?;
        for job in items(&page, "jobs") {
            let id = text(&job["id"]);
            if job["name"] == reference || begins.as_ref().is_some_and(|prefix| id.starts_with(prefix)) {
                found.push([id, text(&job["name"]), text(&job["state"])]);
            }
        }
        next = page["next_page_token"].as_str().filter(|token| !token.is_empty()).map(str::to_owned);
    }
    match &found[..] {
        [[id, ..]] => Ok(id.clone()),
        [] => bail!("{reference}: no such job; expected an id, the beginning of an id, or a name. qedgix jobs list shows them"),
        several => {
            let listed: Vec<String> = several.iter().take(LISTED).map(|job| format!("\n  {}", job.join("  "))).collect();
            let more = several.len().checked_sub(LISTED + 1).map(|more| format!("\n  and {} more", more + 1));
            bail!("{reference}: {} jobs match; expected one of{}{}", several.len(), listed.concat(), more.unwrap_or_default())
        }
    }
}

/// The ids of several jobs, each once.
///
/// # Errors
/// As [`resolve`].
pub async fn resolve_all(client: &Client, references: &[String]) -> anyhow::Result<Vec<String>> {
    let mut ids = Vec::new();
    for reference in references {
        let id = resolve(client, reference).await?;
        if !ids.contains(&id) {
            ids.push(id);
        }
    }
    Ok(ids)
}

/// Whether an id can begin with this.
fn is_beginning(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_hexdigit() || c == '-')
}

/// The beginnings of ids that tell them apart: as short as possible, but at least the time of an id.
pub fn short(ids: &[String]) -> Vec<String> {
    /// Characters of the milliseconds in an id of version 7.
    const TIME: usize = 13;
    let mut sorted: Vec<&str> = ids.iter().map(String::as_str).collect();
    sorted.sort_unstable();
    sorted.dedup();
    let common = |a: &str, b: &str| a.bytes().zip(b.bytes()).take_while(|(a, b)| a == b).count();
    let longest = sorted.windows(2).map(|pair| common(pair[0], pair[1]) + 1).max().unwrap_or(0);
    ids.iter().map(|id| id.get(..longest.max(TIME)).unwrap_or(id).trim_end_matches('-').to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_ids_tell_jobs_apart() {
        let id = |end: &str| format!("01a202d1-93be-769e-80f7-75eef9496{end}");
        assert_eq!(short(&[id("f12")]), ["01a202d1-93be"]);
        assert_eq!(short(&[id("f12"), id("e12")]), [id("f")[..34].to_owned(), id("e")[..34].to_owned()]);
        assert_eq!(short(&[id("f12"), "01b202d1-93be-769e-80f7-75eef9496f12".into()]), ["01a202d1-93be", "01b202d1-93be"]);
        assert!(short(&[]).is_empty());
    }
}
