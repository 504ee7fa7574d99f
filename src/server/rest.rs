//! Memory given back once nobody wants work: what is kept goes when it was not asked for a while ([`Limits::rest`]), processes that made
//! photos end, and what the allocator holds beyond that returns to the system.

use std::time::Duration;

use super::app::App;

/// Pause between two looks, as a share of [`Limits::rest`](super::Limits::rest).
const LOOKS: u32 = 8;

/// What has happened since memory was last given back.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
struct Seen {
    /// Work that was begun on scenes.
    entered: u64,
    /// Bytes that are kept.
    kept: u64,
}

impl Seen {
    fn of(app: &App) -> Self {
        let kept = app.scenes.bytes() + app.files.bytes() + app.levels.bytes() + app.views.bytes();
        Self { entered: app.pool.entered(), kept }
    }
}

/// Looks now and then until the server ends.
pub async fn rest(app: App) {
    let mut given_back = Seen::default();
    loop {
        tokio::time::sleep((app.limits.rest / LOOKS).max(Duration::from_millis(10))).await;
        app.settle().await;
        let shared = App::clone(&app);
        let settled = tokio::task::spawn_blocking(move || {
            shared.renderer.settle();
            shared.maker.rest(shared.limits.rest)
        });
        let ended = settled.await.unwrap_or_default();
        let busy = app.pool.bytes() > 0 || app.memory.taken() > 0;
        let seen = Seen::of(&app);
        if !busy && (ended || seen != given_back) {
            // some milliseconds, in which nobody else may allocate
            let _ = tokio::task::spawn_blocking(give_back).await;
            given_back = seen;
        }
    }
}

/// Has all threads allocate from one place: what is free in others cannot be given back whole. A few threads of a server allocate at a
/// time, and what is small each has for itself; `tests/load/allocators.py` compares. Who sets `MALLOC_ARENA_MAX` wants it otherwise.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
pub fn allocate_in_one_place() {
    if std::env::var_os("MALLOC_ARENA_MAX").is_none() {
        // SAFETY: it takes no pointer; where it is refused nothing changes
        unsafe { libc::mallopt(libc::M_ARENA_MAX, 1) };
    }
}

/// Other allocators are as they are.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn allocate_in_one_place() {}

/// Returns to the system what the allocator holds and nobody uses.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
pub fn give_back() {
    // SAFETY: it takes no pointer, and locks what it touches
    unsafe { libc::malloc_trim(0) };
}

/// Other allocators do so by themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn give_back() {}
