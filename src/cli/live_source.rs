//! The frame sources of `tmpi live publish`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use bytes::Bytes;

use tmpi_live::access_units::{Splitter, Unit, is_bidirectional, is_turned};
use tmpi_live::measured_depth;
use tmpi_live::video::{self, JPEG, VideoError};
use tmpi_pipeline::depth::{self as maps, DepthKind};

use super::live_input::{Origin, Plan, Wanted};
use super::live_program::{Program, is_live};
use super::live_rtp::Sound;
use super::note;

/// A frame to send.
#[derive(Clone)]
pub(super) struct Frame {
    pub(super) data: Bytes,
    pub(super) key: bool,
    pub(super) depth: Option<Bytes>,
}

/// Frames of a file, a folder or a program.
pub(super) enum Source {
    /// Files of a folder, the index of the next, and the kind of the depth maps beside them.
    Folder(Vec<PathBuf>, usize, DepthKind),
    /// Units in memory, and the index of the next.
    Units(Vec<Unit>, usize),
    /// A running program that sets the pace.
    Program(Program),
}

impl Source {
    /// Opens the frames of an origin, and its sound if it has sound and `wanted` asks for it.
    ///
    /// # Errors
    /// The file does not exist or has no frame, or ffmpeg cannot read it.
    pub(super) async fn open(origin: Origin<'_>, depth: DepthKind, wanted: Wanted) -> anyhow::Result<(Self, Option<Sound>)> {
        let files = match origin {
            Origin::Address(source) if Path::new(source).is_dir() => Some(Self::folder(Path::new(source), depth)?),
            Origin::Stream(file, _) if !wanted.transcode => Some(Self::stream(Path::new(file))?),
            _ => None,
        };
        if let Some(files) = files {
            return Ok((files, None));
        }
        let plan = Plan::new(origin, wanted)?;
        plan.notices.iter().for_each(|notice| note(&format!("tmpi live publish: {notice}")));
        let sound = if plan.sound { Some(Sound::open().await.context("a port for the sound")?) } else { None };
        let live = matches!(origin, Origin::Camera(_)) || matches!(origin, Origin::Address(source) if is_live(source));
        let program = Program::start(&mut plan.command(sound.as_ref().map(Sound::port)), live)?;
        Ok((Self::Program(program), sound))
    }

    /// JPEG files of a folder.
    fn folder(folder: &Path, depth: DepthKind) -> anyhow::Result<Self> {
        let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
        files.retain(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
        files.sort();
        if files.is_empty() {
            bail!("{} holds no JPEG file", folder.display());
        }
        Ok(Self::Folder(files, 0, depth))
    }

    /// Reads a raw H.264 file that rooms accept unchanged.
    ///
    /// # Errors
    /// [`VideoError::Unsupported`] if they do not.
    fn stream(file: &Path) -> anyhow::Result<Self> {
        let mut splitter = Splitter::default();
        let mut units = Vec::new();
        for piece in std::fs::read(file).with_context(|| file.display().to_string())?.chunks(1 << 16) {
            units.extend(splitter.push(piece)?);
        }
        units.extend(splitter.finish());
        let obstacle = if units.iter().any(|unit| is_bidirectional(&unit.data)) {
            Some("its frames are not in display order (B-frames)")
        } else {
            units.iter().any(|unit| is_turned(&unit.data)).then_some("its frames are rotated")
        };
        if let Some(why) = obstacle {
            return Err(VideoError::Unsupported(why.into()).into());
        }
        Ok(Self::Units(units, 0))
    }

    /// Whether the source sets the pace of its frames.
    pub(super) const fn is_paced(&self) -> bool {
        matches!(self, Self::Program(_))
    }

    /// Units that were dropped in favour of newer ones.
    pub(super) fn left_out(&self) -> u64 {
        if let Self::Program(program) = self { program.left_out() } else { 0 }
    }

    /// The next frame; `None` at the end.
    pub(super) async fn next(&mut self) -> anyhow::Result<Option<Frame>> {
        let unit = match self {
            Self::Folder(files, at, kind) => {
                let Some(file) = files.get(*at) else { return Ok(None) };
                *at += 1;
                let data = tokio::fs::read(file).await.with_context(|| file.display().to_string())?;
                let map = file.with_extension("png");
                let depth = map.is_file().then(|| measured(&map, *kind, &data)).transpose()?;
                return Ok(Some(Frame { data: data.into(), key: true, depth }));
            }
            Self::Units(units, at) => {
                *at += 1;
                units.get(*at - 1).cloned()
            }
            Self::Program(program) => program.next().await?,
        };
        Ok(unit.map(|unit| Frame { data: unit.data.into(), key: unit.key, depth: None }))
    }

    pub(super) fn begin_again(&mut self) {
        if let Self::Folder(_, at, _) | Self::Units(_, at) = self {
            *at = 0;
        }
    }
}

/// Packs the depth map beside a frame.
fn measured(file: &Path, kind: DepthKind, frame: &[u8]) -> anyhow::Result<Bytes> {
    let name = || file.display().to_string();
    let (width, height) = video::size(JPEG, frame)?.with_context(name)?;
    let limits = tmpi_pipeline::photo::Limits::default();
    let (map, _) = maps::from_map(&std::fs::read(file).with_context(name)?, kind, &limits, width, height).with_context(name)?;
    Ok(measured_depth::pack(&map)?.into())
}

#[cfg(test)]
mod tests {
    use std::process::Command;
    use std::time::Duration;

    use tmpi_live::access_units::codec;
    use tmpi_testing::Need;
    use tokio::time::timeout;

    use super::*;

    /// One second of test pictures and a tone, encoded by ffmpeg; `None` without ffmpeg.
    fn film(folder: &Path, name: &str, codec: &[&str]) -> Option<String> {
        let file = folder.join(name);
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-f", "lavfi", "-i", "testsrc=size=160x120:rate=15:duration=1"]);
        command.args(["-f", "lavfi", "-i", "sine=duration=1", "-pix_fmt", "yuv420p"]).args(codec).arg(&file);
        let status = Need::Ffmpeg.or_skip(command.status())?;
        assert!(status.success(), "{name}: {status}");
        Some(file.to_string_lossy().into_owned())
    }

    /// All frames, and the times of the sound packets among them.
    async fn read(origin: &str, wanted: Wanted) -> (Vec<Frame>, Vec<u64>) {
        let (mut source, mut sound) = Source::open(Origin::Address(origin), DepthKind::default(), wanted).await.unwrap();
        let (mut frames, mut times) = (Vec::new(), Vec::new());
        let all = async {
            loop {
                let heard = async {
                    match &mut sound {
                        Some(sound) => sound.next().await.0,
                        None => std::future::pending().await,
                    }
                };
                tokio::select! {
                    biased;
                    time = heard => times.push(time),
                    frame = source.next() => match frame.unwrap() {
                        Some(frame) => frames.push(frame),
                        None => break,
                    },
                }
            }
        };
        timeout(Duration::from_mins(1), all).await.expect("the film ends");
        (frames, times)
    }

    fn is_for_rooms(frames: &[Frame]) -> bool {
        frames.first().is_some_and(|f| f.key && codec(&f.data).is_some()) && !frames.iter().any(|f| is_bidirectional(&f.data))
    }

    #[tokio::test]
    async fn unplayable_video_is_encoded_with_its_sound() {
        let folder = tempfile::tempdir().unwrap();
        let codecs: [&[&str]; 2] = [&["-c:v", "mpeg4", "-c:a", "aac"], &["-c:v", "libx264", "-bf", "2", "-c:a", "aac"]];
        for (n, codec) in codecs.into_iter().enumerate() {
            let Some(film) = film(folder.path(), &format!("{n}.mp4"), codec) else { return };
            let (frames, times) = read(&film, Wanted { transcode: false, sound: true }).await;
            assert!(is_for_rooms(&frames) && (14..=16).contains(&frames.len()), "{} frames of {film}", frames.len());
            // 50 packets a second; the first ones may come before anyone listens, the last after the last frame
            assert!(times.len() > 10 && times.is_sorted(), "{times:?}");
            assert!(times.windows(2).all(|t| t[1] > t[0]), "{times:?}");
        }
    }

    #[tokio::test]
    async fn a_rotated_film_is_refused_with_a_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let turned = ["-c:v", "libx264", "-bf", "0", "-bsf:v", "h264_metadata=display_orientation=insert:rotate=90"];
        for name in ["film.mp4", "film.h264"] {
            let Some(film) = film(folder.path(), name, &[&turned[..], &["-an"]].concat()) else { return };
            if name.ends_with("h264") {
                let raw = Source::open(Origin::Stream(&film, 15.0), DepthKind::default(), Wanted::default()).await;
                assert!(raw.is_err_and(|e| matches!(e.downcast_ref(), Some(VideoError::Unsupported(_)))));
            }
            let wanted = Wanted { transcode: true, sound: false };
            let refused = Source::open(Origin::Address(&film), DepthKind::default(), wanted).await;
            assert!(refused.is_err_and(|e| e.to_string().contains("transpose")), "{name}");
        }
    }

    #[tokio::test]
    async fn playable_video_is_copied_bit_for_bit_without_unwanted_sound() {
        let folder = tempfile::tempdir().unwrap();
        let codec = ["-c:v", "libx264", "-profile:v", "baseline", "-bf", "0", "-c:a", "aac"];
        let Some(film) = film(folder.path(), "film.mp4", &codec) else { return };
        let stream = folder.path().join("film.h264");
        let copied = Command::new("ffmpeg").args(["-loglevel", "error", "-i", &film, "-an", "-c:v", "copy"]).arg(&stream).status();
        assert!(copied.unwrap().success());
        let (frames, times) = read(&film, Wanted::default()).await;
        let sent: Vec<u8> = frames.iter().flat_map(|f| f.data.to_vec()).collect();
        assert!(is_for_rooms(&frames) && times.is_empty() && sent == std::fs::read(&stream).unwrap());
        let (encoded, _) = read(&film, Wanted { transcode: true, sound: false }).await;
        assert!(is_for_rooms(&encoded) && encoded.iter().flat_map(|f| f.data.to_vec()).collect::<Vec<_>>() != sent);
        let missing = Source::open(Origin::Address("no/such/film.mp4"), DepthKind::default(), Wanted::default()).await;
        assert!(missing.is_err_and(|e| e.to_string().contains("No such file")));
    }
}
