//! The memory of this machine, and whether a training run can fit into it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::invalid::Invalid;
use crate::learner::{MemoryEstimate, TrainConfig};
use crate::store::JobSpec;

/// Memory in bytes that this process can use at most: that of the machine, or less if a control group limits it. `u64::MAX` if the
/// system does not say.
pub fn available() -> u64 {
    let read = |path: &Path| std::fs::read_to_string(path).ok();
    let machine = read(Path::new("/proc/meminfo")).and_then(|text| size(&text, "MemTotal:"));
    let groups = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let limits = limit_files(&groups).into_iter().filter_map(|path| read(&path)?.trim().parse().ok());
    limits.chain(machine).min().unwrap_or(u64::MAX)
}

/// A size of `/proc/meminfo` or `/proc/self/status`, in bytes.
fn size(text: &str, field: &str) -> Option<u64> {
    let kib: u64 = text.lines().find_map(|line| line.strip_prefix(field))?.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib << 10)
}

/// The files that limit the memory of the control groups in `/proc/self/cgroup`, and of the groups that contain them.
fn limit_files(groups: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else { continue };
        let (root, file) = match controllers {
            "" => ("/sys/fs/cgroup", "memory.max"),
            _ if controllers.split(',').any(|name| name == "memory") => ("/sys/fs/cgroup/memory", "memory.limit_in_bytes"),
            _ => continue,
        };
        let group = Path::new(path.trim_start_matches('/'));
        files.extend(group.ancestors().map(|group| Path::new(root).join(group).join(file)));
    }
    files
}

/// Memory in bytes of a worker besides what its configuration needs: the program, its buffers, and checkpoints that are sent.
const BASE: u64 = 512 << 20;

/// Memory in bytes that a worker may use unless its job says otherwise: several times the estimate, because a snapshot copies the
/// replay, and allocators keep what they may need again.
pub fn default_limit(config: &TrainConfig, threads: usize) -> u64 {
    MemoryEstimate::of(config, threads).total().saturating_mul(3).saturating_add(BASE)
}

/// Memory in bytes to ask a cluster for: more than the limit of the worker, so that the worker ends by itself, and says why, before the
/// cluster kills it.
pub(super) fn request(spec: Option<&JobSpec>, threads: usize) -> u64 {
    let default = || Some(default_limit(spec?.config.as_ref()?, threads));
    spec.and_then(|spec| spec.limits.memory).or_else(default).unwrap_or(0).saturating_add(BASE)
}

/// Returns when this process uses more than `limit` bytes, with what it uses. Never where the system does not say.
///
/// The address space says nothing: allocators reserve much more than they use.
pub(super) async fn exceeds(limit: u64) -> u64 {
    /// Time between two looks.
    const INTERVAL: Duration = Duration::from_millis(200);
    loop {
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        if let Some(used) = size(&status, "VmRSS:").filter(|used| *used > limit) {
            return used;
        }
        tokio::time::sleep(INTERVAL).await;
    }
}

/// Checks that a run of `config` can fit into `available` bytes.
///
/// # Errors
/// [`Invalid`] with the field that causes most of the estimate, the estimate, and the limit.
pub fn check(config: &TrainConfig, threads: usize, available: u64) -> Result<(), Invalid> {
    let estimate = MemoryEstimate::of(config, threads);
    if estimate.total() <= available {
        return Ok(());
    }
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    let MemoryEstimate { replay, parameters, activations } = estimate;
    let value = format!(
        "about {} MiB of memory (replay {}, parameters {}, activations {})",
        mib(estimate.total()),
        mib(replay),
        mib(parameters),
        mib(activations)
    );
    let expected = format!("a configuration that needs at most {} MiB, the memory of this machine", available >> 20);
    Err(Invalid::new(estimate.largest_field(config), value, expected))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train_config::{Algorithm, Preset};

    #[test]
    fn limits_of_control_groups_are_found() {
        assert_eq!(size("MemFree: 1 kB\nMemTotal:       16 kB\n", "MemTotal:"), Some(16 << 10));
        assert_eq!(size("nonsense", "MemTotal:"), None);
        let files = limit_files("12:cpu,memory:/a\n3:pids:/b\n0::/user/run\nnonsense\n");
        let files: Vec<_> = files.iter().map(|path| path.to_str().unwrap()).collect();
        let expected = [
            "/sys/fs/cgroup/memory/a/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
            "/sys/fs/cgroup/user/run/memory.max",
            "/sys/fs/cgroup/user/memory.max",
            "/sys/fs/cgroup/memory.max",
        ];
        assert_eq!(files, expected);
        assert!(available() > 1 << 20);
    }

    #[tokio::test]
    async fn a_process_knows_what_it_uses() {
        let used = exceeds(0).await;
        assert!((1 << 20..1 << 40).contains(&used), "{used}");
    }

    #[test]
    fn a_cluster_is_asked_for_more_than_the_limit() {
        let config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        let limit = default_limit(&config, 2);
        let mut spec = JobSpec::train(config);
        assert_eq!(request(Some(&spec), 2), limit + BASE);
        spec.limits.memory = Some(1 << 30);
        assert_eq!(request(Some(&spec), 2), (1 << 30) + BASE);
        spec.limits.memory = Some(u64::MAX);
        assert_eq!((request(Some(&spec), 2), request(None, 2)), (u64::MAX, BASE));
    }

    #[test]
    fn a_run_that_cannot_fit_is_refused() {
        let mut config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        check(&config, 1, 1 << 30).unwrap();
        (config.training.buffer, config.training.steps) = (1_000_000, 1_000_000_000);
        let error = check(&config, 1, 1 << 30).unwrap_err();
        assert_eq!(error.field, "training.buffer");
        assert!(error.expected.contains("1024 MiB"), "{error}");
    }
}
