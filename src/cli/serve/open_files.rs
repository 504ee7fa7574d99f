//! The limit of open files.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Open files needed besides connections.
const SPARE_FILES: u64 = 512;

/// Raises the limit of open files to what so many connections need, as far as the system allows.
pub(super) fn raise(connections: u64) {
    let wanted = connections + SPARE_FILES;
    // `None` is no limit
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let most = maximum.map_or(wanted, |maximum| maximum.min(wanted));
    if current.is_some_and(|current| current < most) {
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(most), maximum });
    }
    if most < wanted {
        tracing::warn!(most, wanted, "the limit of open files is too low: raise it, or lower limits.connections");
    }
}
