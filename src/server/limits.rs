//! Every limit of the server: what an operator may set of them, with its range, and what it is where nobody does.
//!
//! The comments of the fields are what `tmpi config --schema` and `docs/reference/configuration.md` say of them.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tmpi_library::Reserve;
use tmpi_pipeline::photo;

use super::units::{DAY, In, MEGA, MIB, SECOND};
use crate::live;

// The file of settings has plain fields in the table `limits`, and each group in a table of its own.
/// Bounds that the server holds its clients to.
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
    /// Photos that may wait. One more is answered 429.
    #[schemars(range(max = 1_000_000))]
    pub queue: usize,
    /// Time that making a photo of up to 12 megapixels may take. Larger ones have as much more.
    #[serde(rename = "job-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub job: Duration,
    /// Memory for making photos: larger ones are made smaller or refused, and as many are made side by side as fit.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 160))]
    pub job_memory: u64,
    /// Time after which a job is taken up again if its worker says nothing any more.
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
    /// Longest time for which a client may take nothing of an answer.
    #[serde(rename = "write-timeout", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub write: Duration,
    /// Connections at a time. More wait in the kernel.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub connections: usize,
    /// Connections at a time from one address (IPv6: one /64 network). More are closed. A proxy is one address unless it is trusted.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub connections_per_address: usize,
    /// Event streams at a time, half of them from one address. One more is answered 503.
    #[serde(rename = "event-streams")]
    #[schemars(range(min = 2, max = 1_000_000))]
    pub streams: usize,
    /// Views drawn at a time, and, apart from them, levels and parts of containers.
    #[schemars(range(min = 1, max = 1024))]
    pub views: usize,
    /// Views that wait for their turn. One more is answered 503.
    #[schemars(range(max = 1_000_000))]
    pub views_waiting: usize,
    /// Memory for work on scenes that are not kept, and as much again for films and files. A scene that needs more is worked on alone.
    #[serde(with = "In::<MIB>")]
    #[schemars(range(min = 1))]
    pub work_memory: usize,
    /// Time after which unused memory goes back to the system: caches, and processes that made photos.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub rest: Duration,
    /// Time after SIGTERM for which everything is still served but `/readyz` says 503, so that proxies look elsewhere. 0 on loopback.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(max = 3600))]
    pub lame_duck: Duration,
    /// Time that requests and jobs in progress have after the server stops taking new ones.
    #[serde(with = "In::<SECOND>")]
    pub drain: Duration,
    /// Disk that stays free for accepted photos: with less, uploads are answered 507. 0 is 64 MiB, or a twentieth of a smaller disk.
    #[serde(with = "In::<MIB>")]
    pub least_free: u64,
    /// Files that the disk can still have, likewise. 0 is 1024, or a hundredth of a smaller disk's.
    pub least_free_files: u64,
    /// Longest time for which a link to a photo is good.
    #[serde(rename = "link-days", with = "In::<DAY>")]
    #[schemars(range(min = 1, max = 36_500))]
    pub link: Duration,
    /// Time for which browsers use TLS alone after one answer by `--tls-cert` (Strict-Transport-Security). 0 sends no such header.
    #[serde(with = "In::<SECOND>")]
    #[schemars(range(max = 63_072_000))]
    pub hsts: Duration,
    /// Time between two checks of a photo's contents against their digests.
    #[serde(rename = "verify-interval", with = "In::<SECOND>")]
    #[schemars(range(min = 1))]
    pub look_over: Duration,
    /// Most that such a check reads in a second.
    #[serde(rename = "verify-rate", with = "In::<MIB>")]
    #[schemars(range(min = 1))]
    pub look_over_rate: u64,
    /// Requests a minute for each key, and for each address without one. 0 turns a rate off.
    pub rates: Rates,
    /// What one owner may have, if the server asks who comes. 0 is no quota.
    pub quotas: Quotas,
    /// When photos are deleted. 0 is never.
    pub retention: Retention,
    /// Films and files to download.
    pub exports: Exports,
    /// Caches.
    pub cache: Caches,
    /// Rooms.
    pub live: live::Bounds,

    /// Photos made at a time: `--workers`.
    #[serde(skip)]
    pub workers: usize,
    /// Time for a request's header to arrive; also how long an idle connection is kept.
    #[serde(skip)]
    pub header_read: Duration,
    /// Bytes a second that a request's body comes at least with, once it has come for [`Limits::body_read`].
    #[serde(skip)]
    pub body_rate: u64,
    /// Bytes a second that a client takes at least of a response, over [`Limits::write`] of waiting for it.
    #[serde(skip)]
    pub write_rate: u64,
    /// Uploads that are read whole to be checked at a time. More wait.
    #[serde(skip)]
    pub changes: usize,
    /// Uploads that may come in beyond the places that are free in the queue: they may be of photos that are known.
    #[serde(skip)]
    pub uploads_beyond: usize,
    /// Pixels of a view.
    #[serde(skip)]
    pub view_pixels: u64,
    /// Longest side of a view in pixels.
    #[serde(skip)]
    pub view_side: u32,
    /// Tries of one job: a photo that took down what made it that often is given up.
    #[serde(skip)]
    pub attempts: u32,
    /// Requests at a time on a connection of HTTP/2.
    #[serde(skip)]
    pub streams_at_once: u32,
    /// Pause between two keep-alive comments of an event stream.
    #[serde(skip)]
    pub keep_alive: Duration,
    /// Time between two looks at what is to go.
    #[serde(skip)]
    pub retain_sweep: Duration,
    /// Time from the start to the first integrity check.
    #[serde(skip)]
    pub look_over_first: Duration,
}

/// Rates a minute. Without them they are off on loopback and behind a proxy that is not trusted, as all clients share an address there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Rates {
    /// Requests. 6000 if strangers come.
    pub requests: u32,
    /// Uploads, and photos made again. 60 if strangers come.
    pub uploads: u32,
    /// Views, films and files to download. 600 if strangers come.
    pub views: u32,
}

impl Rates {
    /// Those of a server that strangers reach without a proxy, or by one that tells them apart.
    pub const FOR_STRANGERS: Self = Self { requests: 6000, uploads: 60, views: 600 };
}

/// What one owner may have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Quotas {
    /// Photos.
    pub photos: u64,
    /// Room of the photos, uploaded and made.
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
    /// Room of all photos, beyond which the least recently viewed are deleted.
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
    /// How many wait for their turn. One more is answered 503.
    #[schemars(range(max = 1_000_000))]
    pub waiting: usize,
    /// Time that one may take.
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
    /// Memory for decoded scenes, and as much again for what views are drawn from on the processor.
    #[serde(with = "In::<MIB>")]
    pub scenes: usize,
    /// Memory for containers and other small files.
    #[serde(with = "In::<MIB>")]
    pub files: usize,
    /// Memory for views that were drawn.
    #[serde(with = "In::<MIB>")]
    pub views: usize,
    /// Disk for files to download that were written while somebody waited.
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
    /// 10 s.
    pub const HEADER_READ: Duration = Duration::from_secs(10);
    /// 5 s where the server is bound beyond loopback; on loopback, where nobody asks, none.
    pub const LAME_DUCK: Duration = Duration::from_secs(5);
    /// 12 megapixels.
    const JOB_PIXELS: u64 = 12_000_000;
    /// Bytes of a request's header: 32 KiB.
    pub const HEADER_BYTES: usize = 32 << 10;
    /// Pictures drawn for one request, views times frames: the longest film for two eyes.
    pub const RENDERS: u32 = 480;
    /// Photos on one page of the list.
    pub const PAGE: usize = 200;
    /// Longer side of a thumbnail in pixels.
    pub const THUMBNAIL: u32 = 320;

    /// Those of a server that has `memory` bytes for itself and for what makes photos: a sixteenth is for the program, as much for all
    /// caches and half of that for work on scenes, which take turns with photos, whose own bound is above what they take.
    #[must_use]
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

    /// Those of the library.
    #[must_use]
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
        }
    }

    /// Room that is kept free on the disk.
    #[must_use]
    pub fn reserve(&self) -> Reserve {
        Reserve { bytes: some(self.least_free), files: some(self.least_free_files) }
    }

    /// Bounds on a photo.
    #[must_use]
    pub fn photo(&self) -> photo::Limits {
        photo::Limits { bytes: self.body, pixels: self.pixels, memory: self.job_memory, ..photo::Limits::default() }
    }

    /// Time that making a photo may take.
    #[must_use]
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
            // a job of a worker that was killed is taken up again within 10 s; it is renewed every 2 s
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
            rest: Duration::from_secs(20),
            lame_duck: Duration::ZERO,
            drain: Duration::from_secs(20),
            least_free: 0,
            least_free_files: 0,
            link: Duration::from_hours(24 * 366),
            // whoever goes back to plain HTTP has lost browsers for no longer than a week
            hsts: Duration::from_hours(24 * 7),
            look_over: Duration::from_hours(24),
            // 100 000 photos of 500 KB in half an hour
            look_over_rate: 32 << 20,
            rates: Rates::default(),
            quotas: Quotas::default(),
            retention: Retention::default(),
            exports: Exports::default(),
            cache: Caches::default(),
            live: live::Bounds::default(),
            // a job keeps all cores busy by itself
            workers: 1,
            header_read: Self::HEADER_READ,
            // 32 MiB in a little more than an hour
            body_rate: 8 << 10,
            write_rate: 1 << 10,
            changes: 8,
            uploads_beyond: 4,
            attempts: 3,
            streams_at_once: 64,
            keep_alive: Duration::from_secs(15),
            retain_sweep: Duration::from_hours(1),
            look_over_first: Duration::from_mins(1),
        }
    }
}

/// None for 0.
fn some(n: u64) -> Option<u64> {
    Some(n).filter(|n| *n > 0)
}
