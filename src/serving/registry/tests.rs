//! Tests of the memory of policies.

use super::*;
use crate::invalid::Invalid;
use crate::policy::{EnvParams, FleetStep, Policy, RequiredInput};
use jiff::Timestamp;

struct Still;

impl Policy for Still {
    fn actions(&self) -> usize {
        9
    }

    fn needs(&self) -> RequiredInput {
        RequiredInput::Detections
    }

    fn env(&self) -> EnvParams {
        EnvParams::default()
    }

    fn check_fleet(&self, _uavs: usize, _users: usize) -> Result<(), Invalid> {
        Ok(())
    }

    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        0
    }

    fn start(&self, _uavs: usize, _users: usize, _seed: u64, _memory: &mut [f32]) {}

    fn act(&self, _steps: &mut [FleetStep<'_>]) {}
}

fn reference(version: u64) -> PolicyRef {
    PolicyRef { name: "p".into(), version, digest: [version as u8; 32] }
}

fn spec(version: u64) -> PolicySpec {
    PolicySpec { name: "p".into(), version: VersionSelector::Version(version) }
}

/// A registry with a budget of 30 bytes and versions 1 to `versions`.
fn registry(versions: u64) -> Registry {
    let registry = Registry::new(30);
    (1..=versions).for_each(|version| registry.add(reference(version)));
    registry
}

/// Loads a version of 10 bytes.
fn load(registry: &Registry, version: u64) -> Result<Arc<LoadedPolicy>, Error> {
    let share = registry.take_memory(10)?;
    let baseline = LoadedPolicy::baseline(reference(version), "", Arc::new(Still), Timestamp::UNIX_EPOCH);
    Ok(registry.keep(LoadedPolicy::new(baseline.info.clone(), baseline.implementation, share)))
}

fn in_memory(registry: &Registry) -> Vec<u64> {
    let held = |version: &VersionState| registry.in_memory(&version.reference).is_some();
    registry.versions().iter().filter(|version| held(version)).map(|version| version.reference.version).collect()
}

#[test]
fn the_version_that_was_not_used_for_the_longest_time_leaves_memory() {
    let registry = registry(5);
    for version in [1, 2, 3] {
        load(&registry, version).unwrap();
    }
    assert!(matches!(registry.resolve(&spec(1)), Ok(Resolved::InMemory(_))));
    load(&registry, 4).unwrap();
    assert_eq!((in_memory(&registry), registry.memory_used()), (vec![1, 3, 4], 30));
    assert!(matches!(registry.resolve(&spec(2)), Ok(Resolved::Stored(found)) if found == reference(2)));
    load(&registry, 5).unwrap();
    assert_eq!(in_memory(&registry), [1, 4, 5]);
    assert!(registry.versions().iter().all(|version| version.loaded), "callers do not notice");
}

#[test]
fn versions_in_use_stay_and_count_until_they_are_dropped() {
    let registry = registry(5);
    let used: Vec<_> = [1, 2, 3].map(|version| load(&registry, version).unwrap()).into();
    assert!(matches!(load(&registry, 4), Err(Error::Busy(_))));
    registry.set_loaded("p", 1, false);
    assert_eq!(registry.memory_used(), 30, "a session still uses the unloaded version");
    drop(used);
    load(&registry, 4).unwrap();
    assert_eq!((in_memory(&registry), registry.memory_used()), (vec![2, 3, 4], 30));
    assert!(matches!(registry.take_memory(31), Err(Error::Busy(_))));
    registry.take_memory(30).unwrap();
    assert_eq!((in_memory(&registry), registry.memory_used()), (vec![], 0));
}

#[test]
fn a_version_in_use_or_with_an_alias_is_not_removed() {
    let registry = registry(3);
    registry.set_alias("p", "live", 2);
    let used = load(&registry, 1).unwrap();
    let refused = |versions: &[u64]| match registry.remove("p", versions) {
        Err(Error::Precondition { code, .. }) => code,
        other => panic!("{other:?}"),
    };
    assert_eq!([refused(&[3, 1]), refused(&[3, 2])], [ErrorCode::WrongState; 2]);
    assert_eq!(registry.len(), 3, "all or none");
    drop(used);
    let removed = registry.remove("p", &[1, 3]).unwrap();
    assert_eq!((removed.numbers(), registry.len()), (vec![1, 3], 1));
    assert!(registry.version_of_digest("p", &[1; 32]).is_none());
    registry.restore(removed);
    assert_eq!((registry.len(), in_memory(&registry)), (3, vec![1]));
    assert_eq!(registry.version_of_digest("p", &[1; 32]).unwrap().reference, reference(1));
}

#[test]
fn excess_versions_are_the_oldest_without_alias_and_use() {
    let registry = registry(6);
    registry.set_alias("p", "live", 2);
    let _used = load(&registry, 1).unwrap();
    assert_eq!(registry.excess_versions("p", 2), [3, 4]);
    assert!(registry.excess_versions("p", 5).is_empty());
    assert!(registry.excess_versions("q", 1).is_empty());
}
