//! The limit of open files of the process (`ulimit -n`): every connection is one.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Open files that are no connections within `--max-connections`: the database, listeners, workers, and the reserve for probes.
const OTHERS: u64 = 256;

/// Raises the limit as far as the system permits. Returns how many of so many `connections` it has room for, and logs when these
/// are fewer: without room, not even probes get in.
pub(super) fn make_room(connections: usize) -> usize {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let raised = current != maximum && setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }).is_ok();
    let limit = (if raised { maximum } else { current }).unwrap_or(u64::MAX);
    let room = room(limit, connections);
    if room < connections {
        tracing::warn!(
            limit,
            wanted = connections,
            connections = room,
            "the limit of open files (ulimit -n) is too low for --max-connections; fewer connections are accepted"
        );
    }
    room
}

fn room(limit: u64, connections: usize) -> usize {
    let free = limit.saturating_sub(OTHERS).max(limit / 2).max(1);
    connections.min(usize::try_from(free).unwrap_or(usize::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_files_keep_their_room() {
        assert_eq!(room(u64::MAX, 10_000), 10_000);
        assert_eq!(room(10_256, 10_000), 10_000);
        assert_eq!(room(1024, 10_000), 768);
        assert_eq!(room(64, 10_000), 32);
        assert_eq!(room(1, 10_000), 1);
    }
}
