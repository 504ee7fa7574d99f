//! Every limit of the server, as a named constant and as a value that can be set.

use std::time::Duration;

use tmpi_pipeline::photo;

use tmpi_library::Reserve;

/// Bounds that the server holds its clients to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bounds on the photo itself.
    pub photo: photo::Limits,
    /// Body of a request in bytes.
    pub body: usize,
    /// Header of a request in bytes.
    pub header: usize,
    /// Time for a request's header to arrive; also how long an idle connection is kept.
    pub header_read: Duration,
    /// Time from the end of a request's body to its response's header.
    pub request: Duration,
    /// The same for films and files to download, as long as the client waits.
    pub export: Duration,
    /// Longest pause between two pieces of a request's body.
    pub body_read: Duration,
    /// Bytes a second that a request's body comes at least with, once it has come for [`Limits::body_read`].
    pub body_rate: u64,
    /// Uploads that are read whole to be checked at a time. More wait.
    pub changes: usize,
    /// Uploads that may come in beyond the places that are free in the queue: they may be of photos that are known.
    pub uploads_beyond: usize,
    /// Requests a minute for each key, and each address without one; 0 for any number.
    pub rate_requests: u32,
    /// Uploads, and photos made again, the same way.
    pub rate_uploads: u32,
    /// Views, films and files to download, the same way.
    pub rate_views: u32,
    /// Photos of one owner; any number where there is none.
    pub quota_photos: Option<usize>,
    /// Bytes of one owner's photos, uploaded and made; any number where there is none.
    pub quota_bytes: Option<u64>,
    /// Age at which photos go; never where there is none.
    pub retain: Option<Duration>,
    /// Bytes of all photos beyond which those go that were looked at least recently; any number where there is none.
    pub retain_bytes: Option<u64>,
    /// Time between two looks at what is to go.
    pub retain_sweep: Duration,
    /// Longest time that a client may take no byte of a response.
    pub write: Duration,
    /// Bytes a second that a client takes at least of a response, over [`Limits::write`] of waiting for it.
    pub write_rate: u64,
    /// Time from the signal to stop for which everything is still served but `/readyz` says that the server goes, so that proxies send
    /// nobody here any more.
    pub lame_duck: Duration,
    /// Time that requests and the jobs under way have left after that.
    pub drain: Duration,
    /// Jobs that wait; one more is answered 429.
    pub queue: usize,
    /// Threads that make photos.
    pub workers: usize,
    /// Tries of one job: a photo that took down what made it that often is given up.
    pub attempts: u32,
    /// Time that a job may take for a photo of up to [`Self::JOB_PIXELS`]; larger ones have as much more.
    pub job: Duration,
    /// Memory that jobs may take, in bytes: each of them, and all that run side by side.
    pub job_memory: u64,
    /// Connections at a time; more wait in the kernel's queue.
    pub connections: usize,
    /// Connections at a time from one address (IPv6: one network of 64 bits); more are closed.
    pub connections_per_address: usize,
    /// Requests at a time on a connection of HTTP/2.
    pub streams_at_once: u32,
    /// Event streams at a time, half of them from one address; one more is answered 503.
    pub streams: usize,
    /// Views drawn at a time, and, apart from them, levels and parts of containers.
    pub views: usize,
    /// Views that wait for their turn; one more is answered 503.
    pub views_waiting: usize,
    /// Films and files to download written at a time.
    pub exports: usize,
    /// Films and files that wait for their turn; one more is answered 503.
    pub exports_waiting: usize,
    /// Disk for files that are written as jobs, in bytes.
    pub exports_bytes: u64,
    /// Time for which one is kept that nobody fetches.
    pub exports_for: Duration,
    /// Pictures drawn for one request: views times frames.
    pub renders: u32,
    /// Memory for scenes under work, in bytes, besides those kept, for views and levels, and as much again for films and files; what
    /// needs more is worked on alone.
    pub work_memory: usize,
    /// Pixels of a view.
    pub view_pixels: u64,
    /// Longest side of a view in pixels.
    pub view_side: u32,
    /// Memory for decoded scenes in bytes.
    pub scene_cache: usize,
    /// Memory for containers and other small files in bytes.
    pub file_cache: usize,
    /// Memory for encoded views in bytes.
    pub view_cache: usize,
    /// Disk for files to download, in bytes; they are written anew when they were displaced.
    pub export_cache: usize,
    /// Time after which memory goes back: what is kept in it and nobody asked for, and processes that made photos and have no more to make.
    pub rest: Duration,
    /// Time from the start to the first reading of everything that was made, and from the end of one to the next.
    pub look_over_first: Duration,
    /// See [`Limits::look_over_first`].
    pub look_over: Duration,
    /// Bytes a second that are read for it at most.
    pub look_over_rate: u64,
    /// Time for which a job is left to its worker though nothing is heard of it.
    pub lease: Duration,
    /// Room that is kept free on the disk.
    pub reserve: Reserve,
    /// Longest time for which a link to a photo is good.
    pub link: Duration,
    /// Time for which browsers ask by TLS alone once they were answered so by the server itself; not told where it is none.
    pub hsts: Duration,
    /// Photos on one page of the list.
    pub page: usize,
    /// Pause between two keep-alive comments of an event stream.
    pub keep_alive: Duration,
}

impl Limits {
    /// 32 MiB.
    pub const BODY: usize = 32 << 20;
    /// 10 s.
    pub const HEADER_READ: Duration = Duration::from_secs(10);
    /// 30 s.
    pub const REQUEST: Duration = Duration::from_secs(30);
    /// 10 min.
    pub const EXPORT: Duration = Duration::from_mins(10);
    /// 8 KiB/s: 32 MiB in a little more than an hour.
    pub const BODY_RATE: u64 = 8 << 10;
    /// 8 uploads.
    pub const CHANGES: usize = 8;
    /// 4 uploads.
    pub const UPLOADS_BEYOND: usize = 4;
    /// 6 000 requests a minute, for a server that strangers reach without a proxy.
    pub const RATE_REQUESTS: u32 = 6000;
    /// 60 uploads a minute, for such a server.
    pub const RATE_UPLOADS: u32 = 60;
    /// 600 views a minute, for such a server.
    pub const RATE_VIEWS: u32 = 600;
    /// An hour.
    pub const RETAIN_SWEEP: Duration = Duration::from_hours(1);
    /// 512 connections.
    pub const CONNECTIONS_PER_ADDRESS: usize = 512;
    /// 512 streams.
    pub const STREAMS: usize = 512;
    /// One film or file.
    pub const EXPORTS: usize = 1;
    /// 8 films or files.
    pub const EXPORTS_WAITING: usize = 8;
    /// 1 GiB.
    pub const EXPORTS_BYTES: u64 = 1 << 30;
    /// A day.
    pub const EXPORTS_FOR: Duration = Duration::from_hours(24);
    /// 480 pictures: the longest film for two eyes.
    pub const RENDERS: u32 = 480;
    /// 1 GiB: one scene of 50 megapixels, and small ones beside it.
    pub const WORK_MEMORY: usize = 1 << 30;
    /// 1 GiB.
    pub const EXPORT_CACHE: usize = 1 << 30;
    /// 30 s.
    pub const BODY_READ: Duration = Duration::from_secs(30);
    /// 10 s.
    pub const WRITE: Duration = Duration::from_secs(10);
    /// 1 KiB/s.
    pub const WRITE_RATE: u64 = 1 << 10;
    /// 5 s where the server is bound beyond loopback; on loopback, where nobody asks, none.
    pub const LAME_DUCK: Duration = Duration::from_secs(5);
    /// 20 s.
    pub const DRAIN: Duration = Duration::from_secs(20);
    /// 8 s: a job of a worker that was killed is taken up again within 10 s. It is renewed every 2 s.
    pub const LEASE: Duration = Duration::from_secs(8);
    /// 64 jobs.
    pub const QUEUE: usize = 64;
    /// One worker: a job keeps all cores busy by itself.
    pub const WORKERS: usize = 1;
    /// Three starts.
    pub const ATTEMPTS: u32 = 3;
    /// 120 s.
    pub const JOB: Duration = Duration::from_mins(2);
    /// 12 megapixels.
    pub const JOB_PIXELS: u64 = 12_000_000;
    /// 6 GiB.
    pub const JOB_MEMORY: u64 = 6 << 30;
    /// 1 024 connections.
    pub const CONNECTIONS: usize = 1024;
    /// Two views.
    pub const VIEWS: usize = 2;
    /// 64 views.
    pub const VIEWS_WAITING: usize = 64;
    /// 16 megapixels.
    pub const VIEW_PIXELS: u64 = 16 << 20;
    /// 16 384 pixels.
    pub const VIEW_SIDE: u32 = 16_384;
    /// 256 MiB.
    pub const SCENE_CACHE: usize = 256 << 20;
    /// 64 MiB.
    pub const FILE_CACHE: usize = 64 << 20;
    /// 64 MiB.
    pub const VIEW_CACHE: usize = 64 << 20;
    /// 20 s.
    pub const REST: Duration = Duration::from_secs(20);
    /// A minute.
    pub const LOOK_OVER_FIRST: Duration = Duration::from_mins(1);
    /// A day.
    pub const LOOK_OVER: Duration = Duration::from_hours(24);
    /// 32 MiB/s: 100 000 photos of 500 KB in half an hour.
    pub const LOOK_OVER_RATE: u64 = 32 << 20;
    /// 200 photos.
    pub const PAGE: usize = 200;
    /// 15 s.
    pub const KEEP_ALIVE: Duration = Duration::from_secs(15);
    /// 32 KiB.
    pub const HEADER_BYTES: usize = 32 << 10;
    /// 64 requests.
    pub const STREAMS_AT_ONCE: u32 = 64;
    /// 366 days.
    pub const LINK: Duration = Duration::from_hours(24 * 366);
    /// A week: whoever goes back to plain HTTP has lost browsers for no longer.
    pub const HSTS: Duration = Duration::from_hours(24 * 7);
    /// Longer side of a thumbnail in pixels.
    pub const THUMBNAIL: u32 = 320;
}

impl Limits {
    /// Those of a server that has `memory` bytes for itself and for what makes photos: a sixteenth is for the program, as much for all
    /// caches and half of that for work on scenes, which take turns with photos, whose own bound is above what they take.
    #[must_use]
    pub fn of_memory(memory: u64) -> Self {
        let usual = Self::default();
        let share = |of: u64, most: usize| ((memory / of) as usize).min(most);
        Self {
            scene_cache: share(32, usual.scene_cache),
            file_cache: share(64, usual.file_cache),
            view_cache: share(64, usual.view_cache),
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
            exports: self.exports_waiting as u64,
            attempts: i64::from(self.attempts),
            quota_photos: self.quota_photos.map(|n| n as u64),
            quota_bytes: self.quota_bytes,
            retain: self.retain,
            retain_bytes: self.retain_bytes,
            exports_for: self.exports_for,
            exports_bytes: self.exports_bytes,
        }
    }

    /// Time that making a photo may take.
    #[must_use]
    pub fn time_for(&self, photo: &[u8]) -> Duration {
        let pixels = photo::check(photo, &self.photo).map_or(0, |(_, (w, h))| u64::from(w) * u64::from(h));
        self.job.mul_f64((pixels as f64 / Self::JOB_PIXELS as f64).max(1.0))
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            photo: photo::Limits { memory: Self::JOB_MEMORY, ..photo::Limits::default() },
            body: Self::BODY,
            header: Self::HEADER_BYTES,
            header_read: Self::HEADER_READ,
            request: Self::REQUEST,
            export: Self::EXPORT,
            body_read: Self::BODY_READ,
            body_rate: Self::BODY_RATE,
            changes: Self::CHANGES,
            uploads_beyond: Self::UPLOADS_BEYOND,
            rate_requests: 0,
            rate_uploads: 0,
            rate_views: 0,
            quota_photos: None,
            quota_bytes: None,
            retain: None,
            retain_bytes: None,
            retain_sweep: Self::RETAIN_SWEEP,
            write: Self::WRITE,
            write_rate: Self::WRITE_RATE,
            lame_duck: Duration::ZERO,
            drain: Self::DRAIN,
            queue: Self::QUEUE,
            workers: Self::WORKERS,
            attempts: Self::ATTEMPTS,
            job: Self::JOB,
            job_memory: Self::JOB_MEMORY,
            connections: Self::CONNECTIONS,
            connections_per_address: Self::CONNECTIONS_PER_ADDRESS,
            streams_at_once: Self::STREAMS_AT_ONCE,
            streams: Self::STREAMS,
            views: Self::VIEWS,
            views_waiting: Self::VIEWS_WAITING,
            exports: Self::EXPORTS,
            exports_waiting: Self::EXPORTS_WAITING,
            exports_bytes: Self::EXPORTS_BYTES,
            exports_for: Self::EXPORTS_FOR,
            renders: Self::RENDERS,
            work_memory: Self::WORK_MEMORY,
            view_pixels: Self::VIEW_PIXELS,
            view_side: Self::VIEW_SIDE,
            scene_cache: Self::SCENE_CACHE,
            file_cache: Self::FILE_CACHE,
            view_cache: Self::VIEW_CACHE,
            export_cache: Self::EXPORT_CACHE,
            rest: Self::REST,
            look_over_first: Self::LOOK_OVER_FIRST,
            look_over: Self::LOOK_OVER,
            look_over_rate: Self::LOOK_OVER_RATE,
            lease: Self::LEASE,
            reserve: Reserve::default(),
            link: Self::LINK,
            hsts: Self::HSTS,
            page: Self::PAGE,
            keep_alive: Self::KEEP_ALIVE,
        }
    }
}
