//! Aliases: names for versions that move, and where they have been.

use std::collections::BTreeMap;

use super::{Shelf, in_turn};
use crate::invalid::Invalid;
use crate::service::paging::number;
use crate::service::{App, Error, Page, PageRequest};
use crate::serving::{Kind, PolicyRef, PolicySpec, Registry, Which, check_name};
use crate::store::{AliasMove, Promotion, PromotionFilter};

/// Most aliases of one policy.
const MOST: usize = 100;

/// An alias, and what is to become of it.
#[derive(Clone, Debug)]
pub struct Target {
    /// Name of the policy.
    pub name: String,
    /// The alias.
    pub alias: String,
    /// What it must mean now for anything to happen: a version, or 0 for nothing.
    pub expected: Option<u64>,
    /// Who does it, where that is known.
    pub by: Option<String>,
}

/// Aliases of the policy `name` and the versions that they mean.
///
/// # Errors
/// There is no such policy.
pub fn aliases(app: &App, name: &str) -> Result<BTreeMap<String, u64>, Error> {
    check_name("policy", name)?;
    Ok(app.registry.aliases(name)?)
}

/// Lets an alias mean `version`, for every request that comes afterwards, and returns what it meant before. It may mean
/// that version already: then nothing happens, and nothing is added to its history.
///
/// # Errors
/// There is no such version, it is unloaded, it is a baseline's, or the alias means something else than expected.
pub async fn set_alias(app: &App, target: Target, version: u64) -> Result<Option<u64>, Error> {
    check(&target)?;
    let at = app.clock.now();
    in_turn(app, async move |Shelf { store, registry }| {
        let Target { name, alias, by, .. } = &target;
        let spec = PolicySpec { name: name.clone(), which: Which::Version(version) };
        let found = registry.describe(&spec)?;
        if found.about.kind == Kind::Baseline {
            let message = format!("{name} is a baseline: it has one version and needs no alias");
            return Err(Error::Precondition { code: "no_checkpoint", message });
        }
        check_expected(&registry, &target)?;
        check_alias(&registry, name, alias)?;
        if !found.loaded {
            return Err(unloaded(&found.about.reference));
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
/// There is none, or it means something else than expected.
pub async fn delete_alias(app: &App, target: Target) -> Result<(), Error> {
    check(&target)?;
    let at = app.clock.now();
    in_turn(app, async move |Shelf { store, registry }| {
        let Target { name, alias, by, .. } = &target;
        let Some(version) = registry.aliases(name)?.remove(alias) else {
            return Err(Error::not_found("alias", format!("{name}@{alias}")));
        };
        check_expected(&registry, &target)?;
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
/// [`Error::NotFound`]: there is no such policy. [`Error::Invalid`]: the page size is out of range, or no page returned the
/// token.
pub async fn history(app: &App, name: &str, alias: Option<&str>, page: &PageRequest) -> Result<Page<Promotion>, Error> {
    check_name("policy", name)?;
    if let Some(alias) = alias {
        check_name("alias", alias)?;
    }
    app.registry.aliases(name)?;
    let (limit, before) = (page.usual_limit()?, page.position(number)?);
    let mut moves = app.store.promotions(PromotionFilter { name, alias, before }, limit as u32 + 1).await?;
    let more = moves.len() > limit;
    moves.truncate(limit);
    Ok(Page::new(moves, more, |last| last.id.to_string()))
}

fn check(target: &Target) -> Result<(), Invalid> {
    check_name("policy", &target.name)?;
    check_name("alias", &target.alias)
}

/// Checks that `alias` is one of `name`, or that there is room for it.
pub(super) fn check_alias(registry: &Registry, name: &str, alias: &str) -> Result<(), Error> {
    let known = registry.aliases(name).unwrap_or_default();
    if known.len() < MOST || known.contains_key(alias) {
        return Ok(());
    }
    Err(Invalid::new("alias", format!("{alias:?}, one more"), format!("at most {MOST} aliases of a policy")).into())
}

fn check_expected(registry: &Registry, target: &Target) -> Result<(), Error> {
    let Target { name, alias, expected, .. } = target;
    let now = registry.aliases(name)?.remove(alias).unwrap_or(0);
    let Some(expected) = expected.filter(|&expected| expected != now) else { return Ok(()) };
    let means = |version| if version == 0 { "nothing".to_owned() } else { format!("version {version}") };
    let message = format!("{name}@{alias} means {}, not {} as expected", means(now), means(expected));
    Err(Error::Precondition { code: "alias_moved", message })
}

/// An alias of such a version would make callers fail.
pub(super) fn unloaded(reference: &PolicyRef) -> Error {
    let message = format!("policy {reference} is unloaded; load it before an alias means it");
    Error::Precondition { code: "policy_unloaded", message }
}
