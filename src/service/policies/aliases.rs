//! Aliases: movable names of versions, and the history of their moves.

use super::{PolicyStores, one_at_a_time};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::paging::parse_number;
use crate::service::{App, Error, Page, PageRequest};
use crate::serving::{PolicyKind, PolicyRef, PolicySpec, Registry, VersionSelector, check_name};
use crate::store::{AliasHistoryEntry, AliasHistoryFilter, AliasMove};

/// Maximum number of aliases of one policy.
const MAX_ALIASES: usize = 100;

/// An alias to set or delete.
#[derive(Clone, Debug)]
pub struct AliasChange {
    /// Name of the policy.
    pub name: String,
    /// The alias.
    pub alias: String,
    /// The version that the alias must point to before the change; 0 if it must not exist, `None` for any.
    pub expected: Option<u64>,
    /// Id of the caller's API key.
    pub by: Option<String>,
}

/// A page of the aliases of the policy `name` in order of their names, and the versions that they point to.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Invalid`] for a malformed name or a page size out of range.
pub fn aliases(app: &App, name: &str, page: &PageRequest) -> Result<Page<(String, u64)>, Error> {
    check_name("policy", name)?;
    let limit = page.usual_limit()?;
    let mut rest = app.registry.aliases(name)?.into_iter().filter(|(alias, _)| *alias > page.token);
    let items = rest.by_ref().take(limit).collect();
    Ok(Page::new(items, rest.next().is_some(), |(alias, _): &(String, u64)| alias.clone()))
}

/// Points an alias to `version` for all later requests, and returns the version that it pointed to before. If that is the same
/// version, nothing is added to the history.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version; [`Error::Precondition`] when it is unloaded, the policy is a baseline, or
/// the alias does not point to the expected version; [`Error::Invalid`] for malformed names or too many aliases.
pub async fn set_alias(app: &App, change: AliasChange, version: u64) -> Result<Option<u64>, Error> {
    check_names(&change)?;
    let at = app.clock.now();
    one_at_a_time(app, async move |PolicyStores { store, registry }| {
        let AliasChange { name, alias, by, .. } = &change;
        let spec = PolicySpec { name: name.clone(), version: VersionSelector::Version(version) };
        let found = registry.describe(&spec)?.state;
        if found.kind == PolicyKind::Baseline {
            let message = format!("{name} is a baseline, which has one version and no aliases");
            return Err(Error::Precondition { code: ErrorCode::NoCheckpoint, message });
        }
        check_expected(&registry, &change)?;
        check_alias(&registry, name, alias)?;
        if !found.loaded {
            return Err(unloaded(&found.reference));
        }
        let m = AliasMove { name, alias, to: Some(version), at, by: by.as_deref() };
        let previous = store.move_policy_alias(m).await?;
        registry.set_alias(name, alias, version);
        tracing::info!(policy = name, alias, version, previous, by, "alias set");
        Ok(previous)
    })
    .await
}

/// Deletes an alias.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] when the alias does not point to the expected version.
pub async fn delete_alias(app: &App, change: AliasChange) -> Result<(), Error> {
    check_names(&change)?;
    let at = app.clock.now();
    one_at_a_time(app, async move |PolicyStores { store, registry }| {
        let AliasChange { name, alias, by, .. } = &change;
        let Some(version) = registry.aliases(name)?.remove(alias) else {
            return Err(Error::not_found("alias", format!("{name}@{alias}")));
        };
        check_expected(&registry, &change)?;
        let m = AliasMove { name, alias, to: None, at, by: by.as_deref() };
        store.move_policy_alias(m).await?;
        registry.remove_alias(name, alias);
        tracing::info!(policy = name, alias, version, by, "alias deleted");
        Ok(())
    })
    .await
}

/// Moves of aliases of the policy `name`, newest first; of one alias if `alias` is set.
///
/// # Errors
/// [`Error::NotFound`]: there is no such policy. [`Error::Invalid`]: the page size is out of range, or the token is
/// invalid.
pub async fn history(app: &App, name: &str, alias: Option<&str>, page: &PageRequest) -> Result<Page<AliasHistoryEntry>, Error> {
    check_name("policy", name)?;
    if let Some(alias) = alias {
        check_name("alias", alias)?;
    }
    app.registry.aliases(name)?;
    let (limit, before) = (page.usual_limit()?, page.parse_token(parse_number)?);
    let mut moves = app.store.alias_history(AliasHistoryFilter { name, alias, before }, limit as u32 + 1).await?;
    let more = moves.len() > limit;
    moves.truncate(limit);
    Ok(Page::new(moves, more, |last| last.id.to_string()))
}

fn check_names(change: &AliasChange) -> Result<(), Invalid> {
    check_name("policy", &change.name)?;
    check_name("alias", &change.alias)
}

/// Checks that policy `name` has this alias, or may have another.
pub(super) fn check_alias(registry: &Registry, name: &str, alias: &str) -> Result<(), Error> {
    let known = registry.aliases(name).unwrap_or_default();
    if known.len() < MAX_ALIASES || known.contains_key(alias) {
        return Ok(());
    }
    Err(Invalid::new("alias", format!("{alias:?}"), format!("an existing alias, because a policy has at most {MAX_ALIASES}"))
        .into())
}

fn check_expected(registry: &Registry, change: &AliasChange) -> Result<(), Error> {
    let AliasChange { name, alias, expected, .. } = change;
    let now = registry.aliases(name)?.remove(alias).unwrap_or(0);
    let Some(expected) = expected.filter(|&expected| expected != now) else { return Ok(()) };
    let target = |version| if version == 0 { "nothing".to_owned() } else { format!("version {version}") };
    let message = format!("{name}@{alias} points to {}; expected {}", target(now), target(expected));
    Err(Error::Precondition { code: ErrorCode::AliasMoved, message })
}

/// The error for an alias to an unloaded version, which would make its callers fail.
pub(super) fn unloaded(reference: &PolicyRef) -> Error {
    let message = format!("policy {reference} is unloaded; load it before an alias points to it");
    Error::Precondition { code: ErrorCode::PolicyUnloaded, message }
}
