//! Closed camera paths through the view box, and their frames as an animated picture or a film.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::{MotionRange, View, looking_at};
use tmpi_core::{Camera, Intrinsics, Pose};

/// Time limit of `ffmpeg`: the longest film of the largest frames takes about one minute of one core.
const MAX_TIME: Duration = Duration::from_mins(5);
/// Interval at which the program checks whether `ffmpeg` has ended.
const TICK: Duration = Duration::from_millis(2);
/// Maximum number of bytes of `ffmpeg`'s messages in an error.
const SAID: u64 = 4 << 10;

/// Frames per second.
pub const RATE: u32 = 30;

/// A closed camera path around the camera's pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum Path {
    /// An ellipse to the sides, up and down
    Orbit,
    /// From side to side
    Swing,
    /// Forward and back
    Dolly,
    /// Back and forward, while the lens keeps the middle of the scene as large as it is
    DollyZoom,
    /// Into the nearest thing, and out again
    Zoom,
}

/// How much the lens narrows at the end of [`Path::Zoom`].
const ZOOM: f64 = 1.3;

impl Path {
    /// Names of all paths; viewers and settings use the same names.
    pub const NAMES: [&'static str; 5] = ["orbit", "swing", "dolly", "dolly-zoom", "zoom"];

    /// Returns the path of a name, one of [`Path::NAMES`].
    pub fn from_name(name: &str) -> Option<Self> {
        <Self as clap::ValueEnum>::from_str(name, false).ok()
    }

    /// The camera of frame `frame` of `frames` around `camera`, within the travel of `range`.
    pub fn camera(self, camera: &Camera, frame: u32, frames: u32, range: &MotionRange) -> Camera {
        let (turn, v) = (f64::from(frame) / f64::from(frames.max(1)), &range.travel);
        let (sin, cos) = (turn * std::f64::consts::TAU).sin_cos();
        // there and back: 0 to 1 to 0
        let way = (1.0 - cos) / 2.0;
        let [x, y, z] = match self {
            Self::Orbit => [v.x * cos, v.y * sin, 0.0],
            Self::Swing => [v.x * sin, 0.0, 0.0],
            Self::Dolly => [0.0, 0.0, v.z * sin],
            Self::DollyZoom => [0.0, 0.0, -v.z * way],
            Self::Zoom => [0.0, 0.0, v.z * way],
        };
        let turned = looking_at(range.pivot, x, y, z);
        let mut pose = camera.pose.shifted([x, y, z]);
        (pose.yaw, pose.pitch) = (pose.yaw + turned.yaw, pose.pitch + turned.pitch);
        let intrinsics = match self {
            Self::DollyZoom => magnified(camera, overscan(camera, range) * (1.0 - z * range.pivot), [0.5, 0.5]),
            Self::Zoom => magnified(camera, 1.0 + (ZOOM - 1.0) * way, range.nearest),
            _ => magnified(camera, overscan(camera, range), [0.5, 0.5]),
        };
        Camera { pose, intrinsics, ..*camera }
    }
}

/// Maximum share of each side that a film crops.
const MAX_HIDDEN: f64 = 0.025;

/// Number of positions on a path's ellipse at which the photo's borders are checked.
const LOOKS: u32 = 8;

/// How much a film enlarges the photo, so that what lies beyond its border stays out of sight. The camera turns as it moves, which shifts
/// the borders of a wide lens more than its centre. The result therefore depends on the projected corners of the nearest and the farthest
/// plane.
fn overscan(camera: &Camera, range: &MotionRange) -> f64 {
    let (v, sides) = (&range.travel, [camera.width, camera.height].map(f64::from));
    let needed = |look: u32| {
        let (sin, cos) = (f64::from(look) / f64::from(LOOKS) * std::f64::consts::TAU).sin_cos();
        let (x, y) = (v.x * cos, v.y * sin);
        let turned = looking_at(range.pivot, x, y, 0.0);
        let pose = Pose { yaw: turned.yaw, pitch: turned.pitch, ..Pose::default().shifted([x, y, 0.0]) };
        let moved = Camera { pose, ..*camera };
        let corners = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]].into_iter().flat_map(|share| [(share, 0.0), (share, 1.0)]);
        let past = corners.map(|(share, delta)| {
            let h = tmpi_core::homography([0.0, 0.0, delta], &camera.intrinsics, &moved);
            let [px, py, w] = tmpi_core::mat3_vec(&h, [share[0] * sides[0], share[1] * sides[1], 1.0]);
            // distance from the centre, in halves of a side
            let from_middle = [px / w, py / w].into_iter().zip(sides).map(|(p, side)| (2.0 * p / side - 1.0).abs());
            from_middle.fold(f64::INFINITY, f64::min)
        });
        past.fold(1.0, f64::min)
    };
    let shown = (0..LOOKS).map(needed).fold(1.0, f64::min);
    1.0 / shown.max(1.0 - 2.0 * MAX_HIDDEN)
}

/// The lens that shows everything `by` times as large and keeps `place` (shares of width and height) fixed.
fn magnified(camera: &Camera, by: f64, place: [f64; 2]) -> Intrinsics {
    let k = &camera.intrinsics;
    let about = |c: f64, share: f64, side: u32| share * f64::from(side) * (1.0 - by) + c * by;
    let (cx, cy) = (about(k.cx, place[0], camera.width), about(k.cy, place[1], camera.height));
    Intrinsics { fx: k.fx * by, fy: k.fy * by, cx, cy }
}

/// File format of an animation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum AnimationFormat {
    /// Animated and lossy; repeats forever.
    WebP,
    /// H.264.
    Mp4,
}

impl AnimationFormat {
    /// Returns the format of a name, in any case: `webp` or `mp4`.
    pub fn from_extension(extension: &str) -> Option<Self> {
        match extension.to_ascii_lowercase().as_str() {
            "webp" => Some(Self::WebP),
            "mp4" => Some(Self::Mp4),
            _ => None,
        }
    }

    /// Media type.
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::WebP => "image/webp",
            Self::Mp4 => "video/mp4",
        }
    }

    /// File name extension.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::WebP => "webp",
            Self::Mp4 => "mp4",
        }
    }

    /// Arguments that make `ffmpeg` write the format, for a quality of 1 to 100.
    fn arguments(self, quality: u8) -> Vec<String> {
        let quality = quality.clamp(1, 100);
        let text = |all: &[&str]| all.iter().map(|&a| a.to_owned()).collect::<Vec<_>>();
        match self {
            Self::WebP => [text(&["-c:v", "libwebp_anim", "-loop", "0", "-q:v"]), vec![quality.to_string()]].concat(),
            Self::Mp4 => {
                // quality 90 gives a rate factor of 20, which looks the same as the frames; half-size chroma needs even sides
                let rate = 51 - u32::from(quality) * 31 / 90;
                let even = text(&["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]);
                [text(&["-c:v", "libx264", "-preset", "veryfast", "-crf"]), vec![rate.to_string()], even].concat()
            }
        }
    }
}

/// Why frames could not become an animation.
#[derive(Debug, thiserror::Error)]
pub enum AnimationError {
    /// `ffmpeg` is not installed.
    #[error("animations are written by ffmpeg, which is not installed here")]
    Missing,
    /// A frame differs in size from the first one.
    #[error("all frames must have {0}×{1} pixels")]
    Size(u32, u32),
    /// `ffmpeg` failed.
    #[error("ffmpeg: {0}")]
    Failed(String),
}

/// Encodes frames as a file.
#[derive(Debug)]
pub struct Animation {
    child: Arc<Mutex<Child>>,
    input: Option<ChildStdin>,
    file: PathBuf,
    said: PathBuf,
    size: (u32, u32),
    // dropping this sender ends the watch
    _over: Sender<()>,
    // only this user can read the folder; dropping it deletes its files
    _folder: tempfile::TempDir,
}

impl Animation {
    /// Starts an animation of frames of `size` at [`RATE`] frames per second; `quality` is 1 to 100. It is stopped after five minutes.
    ///
    /// # Errors
    /// [`AnimationError::Missing`], [`AnimationError::Failed`].
    pub fn start(format: AnimationFormat, size: (u32, u32), quality: u8) -> Result<Self, AnimationError> {
        Self::start_for(MAX_TIME, format, size, quality)
    }

    fn start_for(time: Duration, format: AnimationFormat, size: (u32, u32), quality: u8) -> Result<Self, AnimationError> {
        let failed = |e: std::io::Error| AnimationError::Failed(e.to_string());
        let folder = tempfile::Builder::new().prefix("tmpi-").tempdir().map_err(failed)?;
        // `ffmpeg` finishes a file by seeking back to its start, which a pipe does not allow; messages go to a file, because an unread pipe
        // would fill
        let (file, said) = (folder.path().join(format!("film.{}", format.extension())), folder.path().join("said"));
        let mut command = Command::new("ffmpeg");
        command.args(["-hide_banner", "-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{}x{}", size.0, size.1), "-r", &RATE.to_string(), "-i", "pipe:0"]);
        command.args(format.arguments(quality)).arg(&file);
        let messages = File::create(&said).map_err(failed)?;
        let child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(messages).spawn();
        let mut child = child.map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => AnimationError::Missing,
            _ => AnimationError::Failed(e.to_string()),
        })?;
        let input = child.stdin.take();
        let child = Arc::new(Mutex::new(child));
        let (over, ended) = channel();
        let watched = Arc::clone(&child);
        let watch = std::thread::Builder::new().name("tmpi-film".into()).spawn(move || {
            if matches!(ended.recv_timeout(time), Err(RecvTimeoutError::Timeout)) {
                // the process may have ended just now
                let _ = watched.lock().unwrap_or_else(PoisonError::into_inner).kill();
            }
        });
        let animation = Self { child, input, file, said, size, _over: over, _folder: folder };
        watch.map(|_| animation).map_err(failed)
    }

    /// Adds a frame; transparent pixels lie over black.
    ///
    /// # Errors
    /// [`AnimationError::Size`], [`AnimationError::Failed`].
    pub fn push(&mut self, view: &View) -> Result<(), AnimationError> {
        if (view.width, view.height) != self.size {
            return Err(AnimationError::Size(self.size.0, self.size.1));
        }
        let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
        let written = self.input.as_mut().map_or(Ok(()), |pipe| pipe.write_all(rgb.as_flattened()));
        // a broken pipe means that `ffmpeg` ended; its messages say why
        written.or_else(|e| self.ended().and(Err(AnimationError::Failed(e.to_string()))))
    }

    /// Ends the animation and returns its file.
    ///
    /// # Errors
    /// [`AnimationError::Failed`].
    pub fn finish(mut self) -> Result<Vec<u8>, AnimationError> {
        self.ended()?;
        std::fs::read(&self.file).map_err(|e| AnimationError::Failed(e.to_string()))
    }

    /// Waits for `ffmpeg` to end; if it failed, returns an error with its messages.
    fn ended(&mut self) -> Result<(), AnimationError> {
        drop(self.input.take());
        let status = self.wait().map_err(|e| AnimationError::Failed(e.to_string()))?;
        if status.success() {
            return Ok(());
        }
        let mut said = Vec::new();
        // messages that cannot be read are left out
        let _ = File::open(&self.said).and_then(|f| f.take(SAID).read_to_end(&mut said));
        Err(AnimationError::Failed(format!("{status}: {}", String::from_utf8_lossy(&said).trim())))
    }

    /// Waits without holding the lock, so that the watch can kill `ffmpeg`.
    fn wait(&self) -> std::io::Result<ExitStatus> {
        loop {
            let ended = self.child.lock().unwrap_or_else(PoisonError::into_inner).try_wait()?;
            match ended {
                Some(status) => return Ok(status),
                None => std::thread::sleep(TICK),
            }
        }
    }
}

impl Drop for Animation {
    fn drop(&mut self) {
        let mut child = self.child.lock().unwrap_or_else(PoisonError::into_inner);
        // abandoned before its end, or already ended
        let _ = child.kill();
        let _ = child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::ViewBox;

    #[test]
    fn ways_stay_in_what_the_scene_travels_and_close() {
        let travel = ViewBox { x: 0.1, y: 0.05, z: 0.2 };
        let range = MotionRange { travel, pivot: 0.4, nearest: [0.25, 0.75] };
        let own = Camera { pose: Pose::default(), intrinsics: Intrinsics::centred(60, 40, 50.0), width: 60, height: 40 };
        for name in Path::NAMES {
            let path = Path::from_name(name).unwrap();
            for i in 0..=24 {
                let Camera { pose: p, intrinsics: k, .. } = path.camera(&own, i, 24, &range);
                assert!(p.tx.abs() <= 0.1 + 1e-9 && p.ty.abs() <= 0.05 + 1e-9 && p.tz.abs() <= 0.2 + 1e-9, "{name} {i}: {p:?}");
                // views do not look past the borders more than a camera that moves does
                assert!(k.fx >= own.intrinsics.fx - 1e-9, "{name} {i}: {k:?}");
            }
            let (a, b) = (path.camera(&own, 0, 24, &range).pose, path.camera(&own, 24, 24, &range).pose);
            assert!((a.tx - b.tx).abs() + (a.ty - b.ty).abs() + (a.tz - b.tz).abs() < 1e-9, "{name}");
        }
        assert!(Path::from_name("spiral").is_none());
        let turned = Pose { yaw: 90.0, ..Pose::default() }.shifted([1.0, 0.0, 0.0]);
        assert!(turned.tx.abs() < 1e-9 && (turned.tz + 1.0).abs() < 1e-9, "right of a camera that looks right is back");
    }

    #[test]
    fn what_a_way_is_about_stays_in_its_place() {
        let range = MotionRange { travel: ViewBox { x: 0.1, y: 0.1, z: 0.2 }, pivot: 0.4, nearest: [0.25, 0.75] };
        let own = Camera { pose: Pose::default(), intrinsics: Intrinsics::centred(60, 40, 50.0), width: 60, height: 40 };
        // half of the way, a point at the pivot is as large and as far from the middle as everywhere in the film
        let (over, at) = (overscan(&own, &range), path_place(Path::DollyZoom, &own, &range, [48.0, 30.0], 0.4));
        assert!((at[0] - 30.0 - 18.0 * over).abs() < 1e-9 && (at[1] - 20.0 - 10.0 * over).abs() < 1e-9, "{at:?}");
        let far = path_place(Path::DollyZoom, &own, &range, [48.0, 30.0], 0.0);
        assert!(far[0] > at[0] + 0.1, "what is far grows: {far:?}");
        // the lens stays on the nearest thing, which infinity tells from the step forward
        let at = path_place(Path::Zoom, &own, &range, [15.0, 30.0], 0.0);
        assert!((at[0] - 15.0).abs() < 1e-9 && (at[1] - 30.0).abs() < 1e-9, "{at:?}");
    }

    /// Where a pixel of disparity `delta` is half of the way.
    fn path_place(path: Path, own: &Camera, range: &MotionRange, pixel: [f64; 2], delta: f64) -> [f64; 2] {
        let camera = path.camera(own, 1, 2, range);
        let h = tmpi_core::homography([0.0, 0.0, delta], &own.intrinsics, &camera);
        let [x, y, w] = tmpi_core::mat3_vec(&h, [pixel[0], pixel[1], 1.0]);
        [x / w, y / w]
    }

    #[test]
    fn films_show_nothing_from_beyond_the_borders_where_the_photo_moves_as_usual() {
        let range = MotionRange { travel: ViewBox { x: 0.03, y: 0.02, z: 0.02 }, pivot: 0.5, nearest: [0.5, 0.5] };
        let own = Camera { pose: Pose::default(), intrinsics: Intrinsics::centred(600, 400, 350.0), width: 600, height: 400 };
        for (path, i) in [Path::Swing, Path::Orbit].into_iter().flat_map(|path| (0..=24).map(move |i| (path, i))) {
            let camera = path.camera(&own, i, 24, &range);
            for (x, y, delta) in [0.0, 600.0].into_iter().flat_map(|x| [(x, 0.0, 0.0), (x, 400.0, 0.0), (x, 0.0, 1.0), (x, 400.0, 1.0)]) {
                let h = tmpi_core::homography([0.0, 0.0, delta], &own.intrinsics, &camera);
                let [u, v, w] = tmpi_core::mat3_vec(&h, [x, y, 1.0]);
                let inside = |at: f64, border: f64, side: f64| if border == 0.0 { at > 0.5 } else { at < side - 0.5 };
                assert!(
                    !inside(u / w, x, 600.0) && !inside(v / w, y, 400.0),
                    "{path:?} {i}: {x}, {y} at {delta} is seen at {}, {}",
                    u / w,
                    v / w
                );
            }
        }
    }

    /// None where there is no ffmpeg.
    fn started(animation: Result<Animation, AnimationError>) -> Option<Animation> {
        let missing = animation.map_err(|e| if matches!(e, AnimationError::Missing) { e } else { panic!("{e}") });
        tmpi_testing::Need::Ffmpeg.or_skip(missing)
    }

    const LEVELS: [u8; 4] = [10, 80, 160, 240];

    /// A file of four frames of one colour each, and no trace of it.
    fn animated(format: AnimationFormat) -> Option<Vec<u8>> {
        let view = |level: u8| View { width: 33, height: 21, rgba: vec![[level, 90, 200, 255]; 33 * 21] };
        let mut animation = started(Animation::start(format, (33, 21), 80))?;
        let file = animation.file.clone();
        assert!(matches!(animation.push(&View { width: 1, ..view(0) }), Err(AnimationError::Size(33, 21))));
        for level in LEVELS {
            animation.push(&view(level)).unwrap();
        }
        let bytes = animation.finish().unwrap();
        assert!(!file.exists(), "nothing is left behind");
        Some(bytes)
    }

    #[test]
    fn a_webp_shows_each_frame_in_its_place() {
        use image::AnimationDecoder as _;
        let Some(bytes) = animated(AnimationFormat::WebP) else { return };
        let decoder = image::codecs::webp::WebPDecoder::new(std::io::Cursor::new(bytes)).unwrap();
        let frames = decoder.into_frames().collect_frames().unwrap();
        assert_eq!(frames.len(), LEVELS.len());
        for (frame, level) in frames.iter().zip(LEVELS) {
            let picture = frame.buffer();
            assert_eq!(picture.dimensions(), (33, 21));
            let off = picture.pixels().flat_map(|p| [p.0[0].abs_diff(level), p.0[1].abs_diff(90), p.0[2].abs_diff(200)]).max();
            assert!(off <= Some(8), "{off:?} levels off at {level}");
        }
    }

    #[test]
    fn an_mp4_holds_each_frame() {
        let Some(bytes) = animated(AnimationFormat::Mp4) else { return };
        assert_eq!(&bytes[4..8], b"ftyp");
        // the table of sample sizes: version, one size for all, count
        let at = bytes.windows(4).position(|w| w == b"stsz").unwrap();
        assert_eq!(bytes[at + 12..at + 16], (LEVELS.len() as u32).to_be_bytes());
    }

    #[test]
    fn one_that_takes_too_long_is_stopped_and_leaves_nothing() {
        let time = Duration::from_millis(50);
        let Some(mut animation) = started(Animation::start_for(time, AnimationFormat::Mp4, (64, 64), 80)) else { return };
        let folder = animation.file.parent().unwrap().to_owned();
        let view = View { width: 64, height: 64, rgba: vec![[9, 90, 200, 255]; 64 * 64] };
        animation.push(&view).unwrap();
        // it waits for frames that do not come
        assert!(animation.wait().is_ok_and(|status| !status.success()));
        drop(animation);
        assert!(!folder.exists());
    }
}
