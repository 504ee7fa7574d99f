//! Returns memory once the server is idle: unused cache entries are dropped ([`Limits::idle`]), idle child processes end, and the allocator
//! returns free memory to the system.

use std::time::Duration;

use super::app_state::App;

/// Checks per [`Limits::idle`](super::Limits::idle).
const CHECKS: u32 = 8;

/// Activity since memory was last returned.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
struct Activity {
    /// Number of work slots entered.
    entered: u64,
    /// Bytes in caches.
    kept: u64,
}

impl Activity {
    fn of(app: &App) -> Self {
        let kept = app.scenes.bytes() + app.files.bytes() + app.levels.bytes() + app.views.bytes();
        Self { entered: app.pool.entered(), kept }
    }
}

/// Checks periodically until the server ends.
pub async fn trim_when_idle(app: App) {
    let mut released = Activity::default();
    loop {
        tokio::time::sleep((app.limits.idle / CHECKS).max(Duration::from_millis(10))).await;
        app.evict_idle().await;
        let shared = App::clone(&app);
        let freed = tokio::task::spawn_blocking(move || {
            shared.renderer.free_dropped_scenes();
            shared.maker.release_idle_memory(shared.limits.idle)
        });
        let ended = freed.await.unwrap_or_default();
        let busy = app.pool.bytes() > 0 || app.memory.taken() > 0;
        let seen = Activity::of(&app);
        if !busy && (ended || seen != released) {
            // takes some milliseconds, during which other threads cannot allocate
            let _ = tokio::task::spawn_blocking(release_free_memory).await;
            released = seen;
        }
    }
}

/// Limits the allocator to one arena: free memory in others cannot be returned whole. Few threads of a server allocate at a time, and small
/// blocks come from per-thread caches; `tests/load/allocators.py` compares. `MALLOC_ARENA_MAX` overrides this.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
pub fn use_one_malloc_arena() {
    if std::env::var_os("MALLOC_ARENA_MAX").is_none() {
        // SAFETY: it takes no pointer; if it fails, nothing changes
        unsafe { libc::mallopt(libc::M_ARENA_MAX, 1) };
    }
}

/// Not needed for other allocators.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn use_one_malloc_arena() {}

/// Returns the allocator's free memory to the system.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
pub fn release_free_memory() {
    // SAFETY: it takes no pointer, and locks what it touches
    unsafe { libc::malloc_trim(0) };
}

/// Other allocators do so on their own.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn release_free_memory() {}
