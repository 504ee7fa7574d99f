//! Health, metrics, and the `OpenAPI` document.

use std::sync::atomic::Ordering;

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::query::NoQuery;
use crate::server::answer_memory::ANSWERS;
use crate::server::app_state::App;
use crate::server::blocking_pool::WorkClass;
use crate::server::conditional::{Entity, respond, respond_uncached};
use crate::server::metrics::{MEDIA_TYPE, Metric};
use crate::server::problem::Problem;
use tmpi_library::Class::Batch;
use tmpi_library::{JobKind, PhotoState as Phase, hex};

/// Health of the server.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Health {
    /// `ok`.
    status: &'static str,
    /// Version of the program.
    version: &'static str,
}

const HEALTHY: Health = Health { status: "ok", version: env!("CARGO_PKG_VERSION") };

/// The process is alive.
#[utoipa::path(
    get, path = "/healthz", tag = "system",
    responses(
        (status = 200, description = "Alive", body = Health),
    )
)]
pub async fn healthz(_: NoQuery) -> Json<Health> {
    Json(HEALTHY)
}

/// The server works: it is not stopping, it can write the library, and no fault of its own keeps it from making photos. A full queue
/// refuses only uploads, so such a node is ready.
#[utoipa::path(
    get, path = "/readyz", tag = "system",
    responses(
        (status = 200, description = "Ready", body = Health),
        (status = 503, description = "Not ready; `detail` says why"),
    )
)]
pub async fn readyz(State(app): State<App>, _: NoQuery) -> Result<Json<Health>, Problem> {
    let (storage, trouble) = (app.storage(), app.trouble());
    let why = if app.leaving.load(Ordering::Acquire) || app.stop.is_cancelled() {
        "the server is stopping"
    } else if let Some(why) = storage {
        why
    } else if let Some(reason) = &trouble {
        reason
    } else {
        return Ok(Json(HEALTHY));
    };
    Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "not-ready", why).retry_after(1))
}

/// Counters and durations for Prometheus.
#[utoipa::path(
    get, path = "/metrics", tag = "system",
    responses(
        (status = 200, description = "OpenMetrics text 1.0.0, which Prometheus reads", body = String, content_type = "application/openmetrics-text"),
    )
)]
pub async fn metrics(State(app): State<App>, _: NoQuery, headers: HeaderMap) -> Response {
    let counts = match app.library.statistics().await {
        Ok(counts) => counts,
        Err(error) => return Problem::from(error).into_response(),
    };
    let of_state = |state| counts.photos.get(&state).copied().unwrap_or_default() as f64;
    let of_kinds = |kinds: &[JobKind]| kinds.iter().map(|kind| counts.waiting_of(*kind)).sum::<u64>() as f64;
    let waiting = |class| app.pool.waiting(class) as f64;
    let batch = counts.waiting.get(&(JobKind::Make, Batch)).copied().unwrap_or_default();
    let mut figures: Vec<Metric> = app.rooms.get().into_iter().flat_map(|rooms| rooms.counts()).collect();
    figures.extend([
        ("tmpi_photos_done", "Finished photos of all nodes", of_state(Phase::Done)),
        ("tmpi_photos_failed", "Photos that could not be made", of_state(Phase::Failed)),
        ("tmpi_photos_damaged", "Finished photos that are damaged", of_state(Phase::Damaged)),
        ("tmpi_photos_bytes", "Bytes of all photos with their results", counts.bytes as f64),
        ("tmpi_queue_depth", "Photos that wait, at all nodes together", of_kinds(&[JobKind::Make])),
        ("tmpi_queue_longest_wait_seconds", "How long the job that waits longest has waited", counts.longest_wait.as_secs_f64()),
        ("tmpi_queue_limit", "Photos that may wait", app.limits.queue as f64),
        ("tmpi_connections_limit", "Connections that may be open", app.limits.connections as f64),
        (
            "tmpi_jobs_running",
            "Photos that are being made, at all nodes together",
            counts.working.get(&JobKind::Make).copied().unwrap_or_default() as f64,
        ),
        ("tmpi_scene_cache_bytes", "Memory of decoded scenes", app.scenes.bytes() as f64),
        ("tmpi_file_cache_bytes", "Memory of cached files", app.files.bytes() as f64),
        ("tmpi_view_cache_bytes", "Memory of encoded views", app.views.bytes() as f64),
        ("tmpi_export_cache_bytes", "Disk of files to download", app.exports.bytes() as f64),
        ("tmpi_level_cache_bytes", "Memory of smaller levels and parts of containers", app.levels.bytes() as f64),
        ("tmpi_work_memory_bytes", "Memory given out to work on scenes", app.pool.bytes() as f64),
        ("tmpi_job_memory_bytes", "Memory that photos under way may take", app.memory.taken() as f64),
        ("tmpi_work_memory_limit_bytes", "Memory that work on scenes may have, besides films and files", app.limits.work_memory as f64),
        ("tmpi_job_memory_limit_bytes", "Memory that photos under way may have", app.limits.job_memory as f64),
        (
            "tmpi_answer_memory_bytes",
            "Memory of answers that are being sent: pieces of files, and answers of HTTP/2 made for one client",
            ANSWERS.held() as f64,
        ),
        ("tmpi_views_waiting", "Views that wait to be drawn", waiting(WorkClass::Interactive)),
        ("tmpi_derived_waiting", "Levels and parts that wait to be made", waiting(WorkClass::Derived)),
        ("tmpi_exports_waiting", "Films and files that wait to be written", waiting(WorkClass::Export)),
        ("tmpi_views_waiting_limit", "Views that may wait, and, apart from them, levels and parts", app.limits.views_waiting as f64),
        ("tmpi_exports_waiting_limit", "Films and files that may wait", app.limits.exports.waiting as f64),
        ("tmpi_exports_stored_bytes", "Bytes of files that were written as jobs", counts.exports_bytes as f64),
        ("tmpi_exports_queued", "Files that wait to be written as jobs", of_kinds(&[JobKind::Export, JobKind::Film])),
        ("tmpi_batch_queued", "Photos of many that wait", batch as f64),
        ("tmpi_peak_rss_bytes", "Peak resident memory of the process", tmpi_pipeline::usage::peak_rss_bytes() as f64),
    ]);
    // some file systems answer slowly
    let shared = App::clone(&app);
    let looked = tokio::task::spawn_blocking(move || {
        let mut figures = of_process();
        if let Some(space) = shared.library.blobs().disk_space() {
            figures.push(("tmpi_data_free_bytes", "Free space on the disk of the data directory", space.bytes as f64));
            // some file systems have no limit
            if space.all_files > 0 {
                figures.push(("tmpi_data_free_files", "Files that the disk of the data directory can still have", space.files as f64));
            }
        }
        figures
    });
    figures.extend(looked.await.unwrap_or_default());
    match app.telemetry.text(&figures) {
        Ok(text) => respond_uncached(&headers, text.into(), MEDIA_TYPE),
        Err(error) => Problem::internal("writing metrics", &error).into_response(),
    }
}

/// What `/proc` tells about this process, with the names of the Prometheus client libraries.
fn of_process() -> Vec<Metric> {
    // minus the descriptor that reads the folder
    let open = std::fs::read_dir("/proc/self/fd").ok().map(|files| files.count().saturating_sub(1) as f64);
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let most = limits.lines().find_map(|line| line.strip_prefix("Max open files")?.split_whitespace().next()?.parse().ok());
    let resident = tmpi_pipeline::usage::resident_bytes().map(|bytes| bytes as f64);
    let all = [
        ("process_resident_memory_bytes", "Resident memory", resident),
        ("process_open_fds", "Open files, connections among them", open),
        ("process_max_fds", "Files that may be open", most),
    ];
    all.into_iter().filter_map(|(name, help, value)| Some((name, help, value?))).collect()
}

/// This document.
#[utoipa::path(
    get, path = "/openapi.json", tag = "system",
    responses(
        (status = 200, description = "OpenAPI document", body = Object),
    )
)]
pub async fn openapi(State(app): State<App>, _: NoQuery, headers: HeaderMap) -> Response {
    let etag = format!("\"{}\"", hex(&Sha256::digest(&app.openapi)[..16]));
    respond(&headers, Entity::json(app.openapi.clone().into(), &etag))
}
