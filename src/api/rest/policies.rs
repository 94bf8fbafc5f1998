//! `/v1/policies`.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::{Deserialize, Serialize};

use super::extract::{Path, Query};
use super::wording::Policy;
use crate::service::{App, Error, policies};
use crate::serving::PolicySpec;
use crate::wire::v1;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Paging {
    #[serde(default)]
    pub page_size: u32,
    #[serde(default)]
    pub page_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct Page {
    policies: Vec<Policy>,
    next_page_token: String,
}

pub(super) async fn list(State(app): State<Arc<App>>, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let (page, next) = policies::list(&app, paging.page_size, &paging.page_token)?;
    let policies = page.into_iter().map(|described| v1::Policy::from(described).into()).collect();
    Ok(Json(Page { policies, next_page_token: next.unwrap_or_default() }))
}

pub(super) async fn get(State(app): State<Arc<App>>, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    let spec: PolicySpec = policy.parse()?;
    Ok(Json(v1::Policy::from(policies::get(&app, &spec)?).into()))
}
