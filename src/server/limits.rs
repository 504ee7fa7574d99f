//! Every limit of the server: those that an operator can set, with range and default, and fixed ones.
//!
//! The comments of fields appear in `tmpi config --schema` and `docs/reference/configuration.md`.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tmpi_library::{RETRIES, Reserve};
use tmpi_pipeline::photo;

use super::units::{DAY, In, MEGA, MIB, SECOND};
use crate::live;

// in the settings file, plain fields are in the table `limits`, and each group has its own table
/// Limits of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Limits {
    /// Largest body of a request.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 1, max = 4096))]
    pub body: usize,
    /// Largest photo.
    #[serde(with = "In::<MEGA>")]
    #[schemars(range(min = 1, max = 50))]
    pub pixels: u64,
    /// Photos that may wait. Further ones are answered 429.
    #[schemars(range(max = 1_000_000))]
    pub queue: usize,
    /// Time that making a photo of up to 12 megapixels may take. Larger ones have as much more.
    #[serde(rename = "job-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub job: Duration,
    /// Memory for making photos. It bounds how many are made at a time; photos that need more are reduced or refused.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 160))]
    pub job_memory: u64,
    /// Time after which a job is retried if its worker is silent.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 2, max = 600))]
    pub lease: Duration,
    /// Time from the end of a request's body to the start of the answer.
    #[serde(rename = "request-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub request: Duration,
    /// Longest pause in the body of a request.
    #[serde(rename = "body-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub body_read: Duration,
    /// Longest time for which a client may read nothing of an answer.
    #[serde(rename = "write-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub write: Duration,
    /// Connections at a time. More wait in the kernel.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub connections: usize,
    /// Connections at a time from one address (IPv6: one /64 network). More are closed. A proxy is one address unless it is trusted.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub connections_per_address: usize,
    /// Event streams at a time, half of them from one address. Further ones are answered 503.
    #[serde(rename = "event-streams")]
    #[schemars(range(min = 2, max = 1_000_000))]
    pub streams: usize,
    /// Views drawn at a time, and, apart from them, levels and parts of containers.
    #[schemars(range(min = 1, max = 1024))]
    pub views: usize,
    /// Views that may wait. Further ones are answered 503.
    #[schemars(range(max = 1_000_000))]
    pub views_waiting: usize,
    /// Memory for work on uncached scenes, and as much again for films and files. A scene that needs more runs alone.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 1))]
    pub work_memory: usize,
    /// Time after which unused memory goes back to the system: caches, and processes that made photos.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub idle: Duration,
    /// Time after SIGTERM in which everything is still served but `/readyz` answers 503, so that load balancers stop routing here. 0 on
    /// loopback.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(max = 3600))]
    pub lame_duck: Duration,
    /// Time for running requests and jobs after the server stops accepting new ones.
    #[serde(with = "In::<SECOND>")]
    pub drain: Duration,
    /// Disk space that stays free for accepted photos: with less, uploads are answered 507. 0 is 64 MiB, or a twentieth of a smaller disk.
    #[serde(with = "In::<MIB>")]
    pub least_free: u64,
    /// Free files (inodes) on the disk, likewise. 0 is 1024, or a hundredth of a smaller disk's.
    pub least_free_files: u64,
    /// Longest lifetime of a link to a photo.
    #[serde(rename = "link-days", with = "In::<DAY>")]
    #[schemars(range(min = 1, max = 36_500))]
    pub link: Duration,
    /// Time for which browsers use only TLS after an answer by `--tls-cert` (Strict-Transport-Security). 0 sends no such header.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(max = 63_072_000))]
    pub hsts: Duration,
    /// Time between two checks of a photo's files against their digests.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub verify_interval: Duration,
    /// Most bytes that these checks read in a second.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 1))]
    pub verify_rate: u64,
    /// Requests a minute for each key, and for each address without one. 0 turns a rate off.
    pub rates: Rates,
    /// What one owner may have, with private access. 0 is no quota.
    pub quotas: Quotas,
    /// When photos are deleted. 0 is never.
    pub retention: Retention,
    /// Films and files to download.
    pub exports: Exports,
    /// Caches.
    pub cache: Caches,
    /// Rooms.
    pub live: live::RoomLimits,

    /// Photos made at a time: `--workers`.
    #[serde(skip)]
    pub workers: usize,
    /// Time for a request's header to arrive; also how long an idle connection is kept.
    #[serde(skip)]
    pub header_read: Duration,
    /// Least bytes a second of a request's body, once it has been arriving for [`Limits::body_read`].
    #[serde(skip)]
    pub body_rate: u64,
    /// Least bytes a second that a client reads of a response, averaged over [`Limits::write`] of waiting for it.
    #[serde(skip)]
    pub write_rate: u64,
    /// Uploads that are read whole and checked at a time. More wait.
    #[serde(skip)]
    pub changes: usize,
    /// Uploads in progress beyond the free places of the queue: their photos may be known already.
    #[serde(skip)]
    pub uploads_beyond: usize,
    /// Pixels of a view.
    #[serde(skip)]
    pub view_pixels: u64,
    /// Longest side of a view in pixels.
    #[serde(skip)]
    pub view_side: u32,
    /// Tries of one job: after that many crashes, the photo fails.
    #[serde(skip)]
    pub attempts: u32,
    /// Requests at a time on an HTTP/2 connection.
    #[serde(skip)]
    pub streams_at_once: u32,
    /// Pause between two keep-alive comments of an event stream.
    #[serde(skip)]
    pub keep_alive: Duration,
    /// Time between two sweeps for expired photos.
    #[serde(skip)]
    pub retain_sweep: Duration,
    /// Time from the start to the first integrity check.
    #[serde(skip)]
    pub verify_first: Duration,
    /// Pauses after failed attempts to deliver an event to a webhook; after one more, the delivery fails.
    #[serde(skip)]
    pub retries: Vec<Duration>,
}

/// Requests a minute. By default off on loopback and behind an untrusted proxy, where all clients share an address.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Rates {
    /// Requests. Default for a public server: 6000.
    pub requests: u32,
    /// Uploads, and photos made again. Default for a public server: 60.
    pub uploads: u32,
    /// Views, films and files to download. Default for a public server: 600.
    pub views: u32,
}

impl Rates {
    /// Rates of a server with remote clients that it can tell apart: without a proxy, or behind a trusted one.
    pub const FOR_STRANGERS: Self = Self { requests: 6000, uploads: 60, views: 600 };
}

/// What one owner may have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Quotas {
    /// Photos.
    pub photos: u64,
    /// Size of the photos, uploaded and made.
    #[serde(rename = "size", with = "In::<MIB>")]
    pub bytes: u64,
}

/// When photos are deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Retention {
    /// Age at which a photo is deleted.
    #[serde(rename = "days", with = "In::<DAY>")]
    #[schemars(range(max = 36_500))]
    pub age: Duration,
    /// Size of all photos, beyond which the least recently viewed are deleted.
    #[serde(rename = "size", with = "In::<MIB>")]
    pub bytes: u64,
}

/// Films and files to download.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Exports {
    /// How many are written at a time.
    #[schemars(range(min = 1, max = 1024))]
    pub workers: usize,
    /// How many may wait. Further ones are answered 503.
    #[schemars(range(max = 1_000_000))]
    pub waiting: usize,
    /// Time limit of one.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub timeout: Duration,
    /// Time for which a finished file is kept after its last download.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub keep: Duration,
    /// Disk for files that were written as jobs. The least recently downloaded are deleted first.
    #[serde(rename = "disk", with = "In::<MIB>")]
    #[schemars(range(min = 1))]
    pub bytes: u64,
}

impl Default for Exports {
    fn default() -> Self {
        Self { workers: 1, waiting: 8, timeout: Duration::from_mins(10), keep: Duration::from_hours(24), bytes: 1 << 30 }
    }
}

/// Caches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Caches {
    /// Memory for decoded scenes, and as much again for the CPU renderer's.
    #[serde(with = "In::<MIB>")]
    pub scenes: usize,
    /// Memory for containers and other small files.
    #[serde(with = "In::<MIB>")]
    pub files: usize,
    /// Memory for rendered views.
    #[serde(with = "In::<MIB>")]
    pub views: usize,
    /// Disk for files to download that were written while the client waited.
    #[serde(with = "In::<MIB>")]
    pub exports: usize,
}

impl Default for Caches {
    fn default() -> Self {
        Self { scenes: 256 << 20, files: 64 << 20, views: 64 << 20, exports: 1 << 30 }
    }
}

impl Limits {
    /// 32 MiB.
    pub const BODY: usize = 32 << 20;
    /// 5 s if the server is bound beyond loopback; 0 on loopback, which has no load balancer.
    pub const LAME_DUCK: Duration = Duration::from_secs(5);
    /// 12 megapixels.
    const JOB_PIXELS: u64 = 12_000_000;
    /// Bytes of a request's header: 32 KiB.
    pub const HEADER_BYTES: usize = 32 << 10;
    /// Pictures per request, views times frames: the longest film for two eyes.
    pub const RENDERS: u32 = 480;
    /// Photos on one page of the list.
    pub const PAGE: usize = 200;
    /// Longer side of a thumbnail in pixels.
    pub const THUMBNAIL: u32 = 320;

    /// Limits of a server with `memory` bytes for itself and the processes that make photos: a sixteenth for the program, a sixteenth for
    /// all caches and half of that for work on scenes, which take turns with photos, whose own bound is above their actual use.
    pub fn of_memory(memory: u64) -> Self {
        let usual = Self::default();
        let share = |of: u64, most: usize| ((memory / of) as usize).min(most);
        let Caches { scenes, files, views, exports } = usual.cache;
        Self {
            cache: Caches { scenes: share(32, scenes), files: share(64, files), views: share(64, views), exports },
            work_memory: share(32, usual.work_memory),
            job_memory: (memory - memory / 16).min(usual.job_memory),
            ..usual
        }
    }

    /// Limits of the library.
    pub fn library(&self) -> tmpi_library::Limits {
        tmpi_library::Limits {
            queue: self.queue as u64,
            exports: self.exports.waiting as u64,
            attempts: self.attempts.into(),
            quota_photos: some(self.quotas.photos),
            quota_bytes: some(self.quotas.bytes),
            retain: Some(self.retention.age).filter(|age| !age.is_zero()),
            retain_bytes: some(self.retention.bytes),
            exports_for: self.exports.keep,
            exports_bytes: self.exports.bytes,
            retries: self.retries.clone(),
        }
    }

    /// Space to keep free on the disk.
    pub fn reserve(&self) -> Reserve {
        Reserve { bytes: some(self.least_free), files: some(self.least_free_files) }
    }

    /// Limits of a photo.
    pub fn photo(&self) -> photo::Limits {
        photo::Limits { bytes: self.body, pixels: self.pixels, memory: self.job_memory, ..photo::Limits::default() }
    }

    /// Time limit of making a photo.
    pub fn time_for(&self, photo: &[u8]) -> Duration {
        let pixels = photo::check(photo, &self.photo()).map_or(0, |(_, (w, h))| u64::from(w) * u64::from(h));
        self.job.mul_f64((pixels as f64 / Self::JOB_PIXELS as f64).max(1.0))
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            body: Self::BODY,
            pixels: photo::Limits::PIXELS,
            queue: 64,
            job: Duration::from_mins(2),
            job_memory: 6 << 30,
            // a job of a killed worker is retried within 10 s; a lease is renewed every 2 s
            lease: Duration::from_secs(8),
            request: Duration::from_secs(30),
            body_read: Duration::from_secs(30),
            write: Duration::from_secs(10),
            connections: 1024,
            connections_per_address: 512,
            streams: 512,
            views: 2,
            views_waiting: 64,
            view_pixels: 16 << 20,
            view_side: 16_384,
            // one scene of 50 megapixels, and small ones beside it
            work_memory: 1 << 30,
            idle: Duration::from_secs(20),
            lame_duck: Duration::ZERO,
            drain: Duration::from_secs(20),
            least_free: 0,
            least_free_files: 0,
            link: Duration::from_hours(24 * 366),
            // so that an operator who returns to plain HTTP loses browsers for at most a week
            hsts: Duration::from_hours(24 * 7),
            verify_interval: Duration::from_hours(24),
            // 100 000 photos of 500 KB in half an hour
            verify_rate: 32 << 20,
            rates: Rates::default(),
            quotas: Quotas::default(),
            retention: Retention::default(),
            exports: Exports::default(),
            cache: Caches::default(),
            live: live::RoomLimits::default(),
            // one job keeps all cores busy
            workers: 1,
            header_read: Duration::from_secs(10),
            // 32 MiB in a little more than an hour
            body_rate: 8 << 10,
            write_rate: 1 << 10,
            changes: 8,
            uploads_beyond: 4,
            attempts: 3,
            streams_at_once: 32,
            keep_alive: Duration::from_secs(15),
            retain_sweep: Duration::from_hours(1),
            verify_first: Duration::from_mins(1),
            retries: RETRIES.to_vec(),
        }
    }
}

/// `None` for 0.
fn some(n: u64) -> Option<u64> {
    Some(n).filter(|n| *n > 0)
}
