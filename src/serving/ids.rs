//! Ids in the order of the request, sorted into canonical order.
//!
//! Two lists translate between the orders. For the request `["c", "a", "b"]` the canonical order is `["a", "b", "c"]`;
//! `request_of_canonical` is `[1, 2, 0]` ("a" is entry 1 of the request), `canonical_of_request` is `[2, 0, 1]` ("c" is last).

use std::collections::HashMap;

use super::{FleetIds, MAX_NODES};
use crate::invalid::Invalid;

impl FleetIds {
    /// Checks an id or a name that a caller chose.
    ///
    /// # Errors
    /// It is empty or too long.
    pub fn check_id(field: &str, id: &str) -> Result<(), Invalid> {
        if !id.is_empty() && id.chars().count() <= Self::MAX_ID_LEN {
            return Ok(());
        }
        Err(Invalid::new(field, format!("{id:?}"), format!("1 to {} characters", Self::MAX_ID_LEN)))
    }
}

/// Ids of UAVs, or of users, with their indices in the request.
#[derive(Debug, Default)]
pub(crate) struct Ids {
    ids: Vec<(String, u32)>,
}

impl Ids {
    /// No ids yet, with memory for `capacity` of them.
    pub(crate) fn with_capacity(capacity: usize) -> Self {
        Self { ids: Vec::with_capacity(capacity) }
    }

    /// Adds the id at `place` of the request's list.
    ///
    /// # Errors
    /// It is empty or too long; `field` names it.
    pub(crate) fn push(&mut self, field: impl FnOnce() -> String, id: String, place: usize) -> Result<(), Invalid> {
        if id.is_empty() || id.len() > FleetIds::MAX_ID_LEN {
            FleetIds::check_id(&field(), &id)?;
        }
        self.ids.push((id, place as u32));
        Ok(())
    }

    /// The ids in canonical order, and `request_of_canonical`.
    pub(crate) fn sorted(mut self) -> (Vec<String>, Vec<u32>) {
        self.ids.sort_unstable_by(|a, b| FleetIds::order(&a.0, &b.0));
        self.ids.into_iter().unzip()
    }
}

/// Checks the numbers of UAVs and users.
pub(crate) fn check_counts(field: &str, uavs: usize, users: usize) -> Result<(), Invalid> {
    if uavs == 0 {
        return Err(Invalid::new(field, "no UAV", "at least 1 UAV"));
    }
    check_nodes(field, uavs + users)
}

/// Checks that there are not too many nodes.
pub(super) fn check_nodes(field: &str, nodes: usize) -> Result<(), Invalid> {
    if nodes > MAX_NODES {
        return Err(Invalid::new(field, format!("{nodes} UAVs and users"), format!("at most {MAX_NODES} UAVs and users")));
    }
    Ok(())
}

/// Checks that no id occurs twice; both lists of ids are in canonical order, with their `request_of_canonical`.
///
/// # Errors
/// An id occurs twice; `field(is_uav, place)` names its second place.
pub(crate) fn check_distinct(
    uavs: (&[String], &[u32]),
    users: (&[String], &[u32]),
    field: impl Fn(bool, u32) -> String,
) -> Result<(), Invalid> {
    let repeated = |is_uav, id: &String, place| {
        Err(Invalid::new(field(is_uav, place), format!("{id:?}"), "an id that no other UAV or user has"))
    };
    for (is_uav, (ids, request_of_canonical)) in [(true, uavs), (false, users)] {
        if let Some(at) = ids.windows(2).position(|pair| pair[0] == pair[1]) {
            return repeated(is_uav, &ids[at + 1], request_of_canonical[at + 1]);
        }
    }
    let mut first = uavs.0.iter().peekable();
    for (id, &place) in users.0.iter().zip(users.1) {
        while first.next_if(|uav| FleetIds::order(uav, id).is_lt()).is_some() {}
        if first.peek() == Some(&id) {
            return repeated(false, id, place);
        }
    }
    Ok(())
}

/// Node index (UAVs first) of each id; the ids are distinct.
pub(super) fn node_indices<'a>(uavs: &'a [String], users: &'a [String]) -> HashMap<&'a str, u32> {
    uavs.iter().chain(users).map(String::as_str).zip(0..).collect()
}

/// The canonical index of each entry of the request: the inverse of `request_of_canonical`.
pub(crate) fn canonical_of_request(request_of_canonical: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..request_of_canonical.len() as u32).collect();
    order.sort_unstable_by_key(|&canonical| request_of_canonical[canonical as usize]);
    order
}
