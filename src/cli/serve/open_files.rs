//! The limit of open files.

/// Open files needed besides connections.
const SPARE_FILES: u64 = 512;

/// Raises the limit of open files to what so many connections need, as far as the system allows.
#[allow(unsafe_code, reason = "two calls of libc on a struct of ours")]
#[allow(clippy::unnecessary_cast, clippy::useless_conversion, reason = "the width differs by system")]
pub(super) fn raise(connections: u64) {
    let wanted = connections + SPARE_FILES;
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the struct outlives the call, which only writes it
    if unsafe { libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) } != 0 {
        return;
    }
    let most = (limit.rlim_max as u64).min(wanted);
    if (limit.rlim_cur as u64) < most {
        limit.rlim_cur = most as libc::rlim_t;
        // SAFETY: the struct outlives the call, which only reads it
        let _ = unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &raw const limit) };
    }
    if most < wanted {
        tracing::warn!(most, wanted, "the limit of open files is too low: raise it, or lower limits.connections");
    }
}
