//! What a server looks at by itself: whether its disk can be written, and whether what is there is as it was made.

use std::sync::Arc;
use std::time::Duration;

use super::app::App;

/// Pause between two looks at the data directory, and while something is amiss: photos are made as soon as it is mended.
const PROBE: Duration = Duration::from_secs(2);
const PROBE_AMISS: Duration = Duration::from_millis(500);
/// Pause before it is looked again whether nobody waits for work.
const LOOK_LATER: Duration = Duration::from_secs(1);

/// Looks now and then whether the data directory can be written and nothing is missing to make photos with, so that asking for it costs nothing.
pub async fn probe(app: App) {
    loop {
        look_at_disk(&app).await;
        tokio::time::sleep(if app.storage().is_some() { PROBE_AMISS } else { PROBE }).await;
    }
}

/// Looks whether the data directory can be written and nothing is missing to make photos with. Where it is full, what is kept there of derived files goes first.
async fn look_at_disk(app: &App) {
    let shared = Arc::clone(app);
    let looked = tokio::task::spawn_blocking(move || (shared.jobs.store.check(), shared.jobs.maker.lacks()));
    let (written, lacks) = looked.await.unwrap_or_else(|e| (Err(std::io::Error::other(e)), None));
    let full = written.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::StorageFull);
    if full {
        app.free_disk().await;
    }
    let trouble = if full { "the data directory has no room left" } else { "the data directory cannot be written" };
    let away = match app.jobs.cluster.clone() {
        Some(cluster) => tokio::task::spawn_blocking(move || cluster.check()).await.is_ok_and(|seen| seen.is_err()),
        None => false,
    };
    let lacks = if away { Some("the store cannot be reached") } else { lacks };
    app.set_storage(written.err().map_or(lacks, |_| Some(trouble)));
}

/// Reads what was made of each photo now and then, while nobody waits for work, so that damage is known before somebody asks for it.
pub async fn look_over(app: App) {
    /// Photos that are taken from the list at a time.
    const PAGE: usize = 64;
    let mut pause = app.limits.look_over_first;
    if app.jobs.cluster.is_some() {
        // what lies in a store is its to look over
        return;
    }
    loop {
        tokio::time::sleep(pause).await;
        pause = app.limits.look_over;
        let mut after = None;
        loop {
            let page = app.jobs.list(after, PAGE);
            for entry in &page.photos {
                while !app.jobs.is_idle() || app.pool.bytes() > 0 {
                    tokio::time::sleep(LOOK_LATER).await;
                }
                let (shared, looked) = (Arc::clone(&app), Arc::clone(entry));
                let read = tokio::task::spawn_blocking(move || shared.jobs.look_over(&looked)).await.unwrap_or_default();
                tokio::time::sleep(Duration::from_secs_f64(read as f64 / app.limits.look_over_rate as f64)).await;
            }
            after = page.photos.last().filter(|_| page.more).map(|entry| entry.key());
            if after.is_none() {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use crate::server::app::{Export, Shared, Stored};
    use crate::server::forgetful::Forgetful;
    use crate::server::jobs::Jobs;
    use crate::server::store::Store;
    use crate::server::{Config, Limits, PhotoId, Problem, maker};

    #[tokio::test]
    async fn a_full_disk_frees_what_can_be_made_again() {
        let files = Arc::new(Forgetful::new());
        let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        let limits = Limits { workers: 0, ..Limits::default() };
        let jobs = Jobs::start(store, Vec::new(), Arc::new(maker::Never), Arc::new(limits.clone()), Arc::default()).unwrap();
        let addr = ([127, 0, 0, 1], 0).into();
        let config = Config { limits, ..Config::new(addr, PathBuf::new()) };
        let renderer = tmpi_render::select(tmpi_render::Backend::Cpu).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let library = Box::pin(tmpi_library::Library::open(tmpi_library::Config::of_folder(dir.path()))).await.unwrap();
        let app = Arc::new(Shared::new(config, addr, library, jobs, renderer, bytes::Bytes::new()));
        let key = ((PhotoId::of(&[1; 32], None, "", ""), 1), String::new());
        let put = async || app.exports.get(key.clone(), async { Ok::<_, Problem>(Export(Stored::new(vec![7; 99]))) }).await.unwrap();
        put().await;
        look_at_disk(&app).await;
        assert!(app.storage().is_none() && app.exports.bytes() > 0);
        files.fill(true);
        look_at_disk(&app).await;
        assert_eq!((app.storage(), app.exports.bytes()), (Some("the data directory has no room left"), 0));
        files.fill(false);
        look_at_disk(&app).await;
        assert!(app.storage().is_none());
        put().await;
        assert!(app.exports.bytes() > 0, "what is made later is kept");
    }
}
