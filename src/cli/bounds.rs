//! Bounds of `tmpi serve` that seldom need to be others; each has its default in [`Limits`].

use std::time::Duration;

use crate::live::Bounds;
use crate::server::{Limits, Reserve};

/// The same as options.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Bounds that seldom need to be others")]
pub(super) struct BoundArgs {
    /// Longest side of a photo, in pixels
    #[arg(long, default_value_t = tmpi_pipeline::photo::Limits::SIDE, value_parser = clap::value_parser!(u32).range(1..=i64::from(tmpi_core::container::MAX_SIDE)), value_name = "PX")]
    max_side: u32,
    /// Memory that a decoder of photos may take, in MiB
    #[arg(long, default_value_t = (tmpi_pipeline::photo::Limits::DECODER_MEMORY >> 20) as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    decoder_memory: u32,
    /// Longest header of a request, in KiB
    #[arg(long, default_value_t = (Limits::HEADER_BYTES >> 10) as u16, value_parser = clap::value_parser!(u16).range(8..=256), value_name = "KIB")]
    max_header: u16,
    /// Seconds for the header of a request to come; also how long an idle connection is kept
    #[arg(long, default_value_t = seconds(Limits::HEADER_READ), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    header_timeout: u32,
    /// Seconds of the longest pause in the body of a request
    #[arg(long, default_value_t = seconds(Limits::BODY_READ), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    body_timeout: u32,
    /// Bytes a second that such a body comes at least with
    #[arg(long, default_value_t = Limits::BODY_RATE as u32, value_name = "BYTES")]
    body_rate: u32,
    /// Seconds for which a client may take nothing of an answer
    #[arg(long, default_value_t = seconds(Limits::WRITE), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    write_timeout: u32,
    /// Bytes a second that it takes at least
    #[arg(long, default_value_t = Limits::WRITE_RATE as u32, value_name = "BYTES")]
    write_rate: u32,
    /// Uploads that are read whole to be checked at a time
    #[arg(long, default_value_t = Limits::CHANGES as u16, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    changes: u16,
    /// Uploads that may come in beyond the places that are free in the queue
    #[arg(long, default_value_t = Limits::UPLOADS_BEYOND as u16, value_name = "N")]
    uploads_beyond: u16,
    /// Starts of a photo that takes down what makes it, until it is given up
    #[arg(long, default_value_t = Limits::ATTEMPTS as u8, value_parser = clap::value_parser!(u8).range(1..), value_name = "N")]
    attempts: u8,
    /// Requests at a time on a connection of HTTP/2
    #[arg(long, default_value_t = Limits::STREAMS_AT_ONCE as u16, value_parser = clap::value_parser!(u16).range(1..=1024), value_name = "N")]
    streams_at_once: u16,
    /// Streams of events at a time, half of them from one address
    #[arg(long, default_value_t = Limits::STREAMS as u32, value_parser = clap::value_parser!(u32).range(2..), value_name = "N")]
    streams: u32,
    /// Seconds between two signs of life of such a stream
    #[arg(long, default_value_t = seconds(Limits::KEEP_ALIVE), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    keep_alive: u32,
    /// Views that wait for their turn; one more is answered 503
    #[arg(long, default_value_t = Limits::VIEWS_WAITING as u32, value_name = "N")]
    views_waiting: u32,
    /// Pixels of a view
    #[arg(long, default_value_t = Limits::VIEW_PIXELS as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    view_pixels: u32,
    /// Longest side of a view, in pixels
    #[arg(long, default_value_t = Limits::VIEW_SIDE, value_parser = clap::value_parser!(u32).range(1..=65_535), value_name = "PX")]
    view_side: u32,
    /// Films and files to download that are written at a time
    #[arg(long, default_value_t = Limits::EXPORTS as u16, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    exports: u16,
    /// Films and files that wait for their turn; one more is answered 503
    #[arg(long, default_value_t = Limits::EXPORTS_WAITING as u16, value_name = "N")]
    exports_waiting: u16,
    /// Disk for files that were written as jobs (POST /v1/photos/ID/exports), in MiB; those that were not fetched for longest go first
    #[arg(long, default_value_t = (Limits::EXPORTS_BYTES >> 20) as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    exports_mib: u32,
    /// Seconds for which an export is kept after its last download
    #[arg(long, default_value_t = seconds(Limits::EXPORTS_FOR), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    exports_for: u32,
    /// Seconds that one may take: as a job, or as long as the client waits
    #[arg(long, default_value_t = seconds(Limits::EXPORT), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    export_timeout: u32,
    /// Pictures drawn for one request: views times frames
    #[arg(long, default_value_t = Limits::RENDERS, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    renders: u32,
    /// Memory for containers and other small files, in MiB [default: 64]
    #[arg(long, value_name = "MIB")]
    file_cache: Option<u32>,
    /// Memory for views that were drawn, in MiB [default: 64]
    #[arg(long, value_name = "MIB")]
    view_cache: Option<u32>,
    /// Disk that is kept free for photos that were accepted, in MiB: with less, uploads are answered 507 [default: 64, or a twentieth of a smaller disk]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    least_free: Option<u32>,
    /// Files that the disk can still have, kept free the same way [default: 1024, or a hundredth of a smaller disk's]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    least_free_files: Option<u32>,
    /// Days for which a link to a photo may be good
    #[arg(long, default_value_t = (Limits::LINK.as_secs() / DAY) as u16, value_parser = clap::value_parser!(u16).range(1..=36_500), value_name = "DAYS")]
    link_days: u16,
    /// Seconds for which browsers that were answered by TLS of --tls-cert ask by nothing else (Strict-Transport-Security); 0: that is not told
    #[arg(long, default_value_t = seconds(Limits::HSTS), value_parser = clap::value_parser!(u32).range(0..=63_072_000), value_name = "S")]
    hsts: u32,
    /// Rooms at a time
    #[arg(long, default_value_t = Bounds::ROOMS as u16, value_parser = clap::value_parser!(u16).range(1..=Bounds::MOST_ROOMS as i64), value_name = "N")]
    live_rooms: u16,
    /// Viewers of a room at this node
    #[arg(long, default_value_t = Bounds::VIEWERS as u32, value_parser = clap::value_parser!(u32).range(1..=1_000_000), value_name = "N")]
    live_viewers: u32,
    /// Largest frame of a room, in KiB
    #[arg(long, default_value_t = (Bounds::FRAME >> 10) as u16, value_parser = clap::value_parser!(u16).range(16..=(Bounds::FRAME >> 10) as i64), value_name = "KIB")]
    live_frame: u16,
    /// Largest packet of sound of a room, in KiB
    #[arg(long, default_value_t = (Bounds::SOUND >> 10) as u16, value_parser = clap::value_parser!(u16).range(1..=64), value_name = "KIB")]
    live_sound: u16,
    /// Photos on one page of the list
    #[arg(long, default_value_t = Limits::PAGE as u16, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    page: u16,
    /// Seconds between two looks at what goes by itself
    #[arg(long, default_value_t = seconds(Limits::RETAIN_SWEEP), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    retain_sweep: u32,
    /// Seconds from the start to the first reading of everything that was made
    #[arg(long, default_value_t = seconds(Limits::LOOK_OVER_FIRST), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    look_over_first: u32,
    /// Seconds from the end of such a reading to the next
    #[arg(long, default_value_t = seconds(Limits::LOOK_OVER), value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    look_over: u32,
    /// MiB a second that are read for it at most
    #[arg(long, default_value_t = (Limits::LOOK_OVER_RATE >> 20) as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    look_over_rate: u32,
}

/// Seconds of a day.
const DAY: u64 = 86_400;

/// Whole seconds of a default.
const fn seconds(time: Duration) -> u32 {
    time.as_secs() as u32
}

impl BoundArgs {
    /// Writes them into `limits`.
    pub fn put(&self, limits: &mut Limits) {
        let time = |seconds: u32| Duration::from_secs(u64::from(seconds));
        let mib = |said: Option<u32>, usual: usize| said.map_or(usual, |mib| (mib as usize) << 20);
        limits.photo.side = self.max_side;
        limits.photo.decoder_memory = u64::from(self.decoder_memory) << 20;
        limits.header = usize::from(self.max_header) << 10;
        limits.header_read = time(self.header_timeout);
        limits.body_read = time(self.body_timeout);
        limits.body_rate = u64::from(self.body_rate);
        limits.write = time(self.write_timeout);
        limits.write_rate = u64::from(self.write_rate);
        limits.changes = usize::from(self.changes);
        limits.uploads_beyond = usize::from(self.uploads_beyond);
        limits.attempts = u32::from(self.attempts);
        limits.streams_at_once = u32::from(self.streams_at_once);
        limits.streams = self.streams as usize;
        limits.keep_alive = time(self.keep_alive);
        limits.views_waiting = self.views_waiting as usize;
        limits.view_pixels = u64::from(self.view_pixels);
        limits.view_side = self.view_side;
        limits.exports = usize::from(self.exports);
        limits.exports_waiting = usize::from(self.exports_waiting);
        limits.exports_bytes = u64::from(self.exports_mib) << 20;
        limits.exports_for = time(self.exports_for);
        limits.export = time(self.export_timeout);
        limits.renders = self.renders;
        limits.file_cache = mib(self.file_cache, limits.file_cache);
        limits.view_cache = mib(self.view_cache, limits.view_cache);
        limits.reserve = Reserve { bytes: self.least_free.map(|mib| u64::from(mib) << 20), files: self.least_free_files.map(u64::from) };
        limits.link = Duration::from_secs(DAY * u64::from(self.link_days));
        limits.hsts = time(self.hsts);
        limits.page = usize::from(self.page);
        limits.retain_sweep = time(self.retain_sweep);
        limits.look_over_first = time(self.look_over_first);
        limits.look_over = time(self.look_over);
        limits.look_over_rate = u64::from(self.look_over_rate) << 20;
    }

    /// Those of rooms.
    pub fn rooms(&self) -> Bounds {
        Bounds {
            rooms: usize::from(self.live_rooms),
            viewers: self.live_viewers as usize,
            frame: usize::from(self.live_frame) << 10,
            sound: usize::from(self.live_sound) << 10,
        }
    }
}
