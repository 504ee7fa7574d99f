//! The frame sources of `tmpi live publish`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use bytes::Bytes;

use tmpi_live::depth_codec;
use tmpi_live::video::{self, JPEG};
use tmpi_pipeline::depth::{self as maps, DepthKind};

use super::live_input::{InputOptions, Origin, Plan};
use super::live_program::Program;
use super::live_rtp::Sound;
use super::note;

#[derive(Clone)]
pub(super) struct Frame {
    pub(super) data: Bytes,
    pub(super) key: bool,
    pub(super) depth: Option<Bytes>,
}

pub(super) enum Source {
    /// Files of a folder, the index of the next, and the kind of the depth maps beside them.
    Folder(Vec<PathBuf>, usize, DepthKind),
    /// A running program that sets the pace.
    Program(Box<Program>),
}

impl Source {
    /// Opens the frames of an origin, and its sound if it has sound and `options` ask for it.
    pub(super) async fn open(origin: Origin<'_>, depth: DepthKind, options: InputOptions) -> anyhow::Result<(Self, Option<Sound>)> {
        if let Origin::Address(source) = origin
            && Path::new(source).is_dir()
        {
            return Ok((Self::folder(Path::new(source), depth)?, None));
        }
        let plan = Plan::new(origin, options)?;
        plan.notices.iter().for_each(|notice| note(&format!("tmpi live publish: {notice}")));
        let sound = if plan.sound { Some(Sound::open().await.context("a port for the sound")?) } else { None };
        let program = Program::start(plan.command(sound.as_ref().map(Sound::port)).into(), origin.is_live())?;
        Ok((Self::Program(program.into()), sound))
    }

    fn folder(folder: &Path, depth: DepthKind) -> anyhow::Result<Self> {
        let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
        files.retain(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
        files.sort();
        if files.is_empty() {
            bail!("{} holds no JPEG file", folder.display());
        }
        Ok(Self::Folder(files, 0, depth))
    }

    /// Units that were dropped in favour of newer ones.
    pub(super) fn left_out(&self) -> u64 {
        if let Self::Program(program) = self { program.left_out() } else { 0 }
    }

    /// The next frame; `None` at the end. Cancel safe for programs.
    pub(super) async fn next(&mut self) -> anyhow::Result<Option<Frame>> {
        match self {
            Self::Folder(files, at, kind) => {
                let Some(file) = files.get(*at) else { return Ok(None) };
                *at += 1;
                let data = tokio::fs::read(file).await.with_context(|| file.display().to_string())?;
                let map = file.with_extension("png");
                let depth = map.is_file().then(|| measured(&map, *kind, &data)).transpose()?;
                Ok(Some(Frame { data: data.into(), key: true, depth }))
            }
            Self::Program(program) => {
                let unit = program.next().await?;
                Ok(unit.map(|unit| Frame { data: unit.data.into(), key: unit.key, depth: None }))
            }
        }
    }

    pub(super) fn begin_again(&mut self) -> anyhow::Result<()> {
        match self {
            Self::Folder(_, at, _) => *at = 0,
            Self::Program(program) => program.begin_again()?,
        }
        Ok(())
    }
}

/// Packs the depth map beside a frame.
fn measured(file: &Path, kind: DepthKind, frame: &[u8]) -> anyhow::Result<Bytes> {
    let name = || file.display().to_string();
    let (width, height) = video::size(JPEG, frame)?.with_context(name)?;
    let limits = tmpi_pipeline::photo::Limits::default();
    let (map, _) = maps::from_map(&std::fs::read(file).with_context(name)?, kind, &limits, width, height).with_context(name)?;
    Ok(depth_codec::pack(&map)?.into())
}

#[cfg(test)]
mod tests {
    use std::process::Command;
    use std::time::Duration;

    use tmpi_live::access_units::{codec, is_bidirectional};
    use tmpi_testing::Need;
    use tokio::time::timeout;

    use super::*;

    /// All frames, and the times of the sound packets among them.
    async fn read(origin: &str, options: InputOptions) -> anyhow::Result<(Vec<Frame>, Vec<u64>)> {
        let (mut source, mut sound) = Source::open(Origin::of(origin, 30.0), DepthKind::default(), options).await?;
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
                    frame = source.next() => match frame? {
                        Some(frame) => frames.push(frame),
                        None => return Ok((frames, times)),
                    },
                }
            }
        };
        timeout(Duration::from_mins(1), all).await.expect("the film ends")
    }

    #[tokio::test]
    async fn playable_video_is_copied_bit_for_bit_and_other_video_encoded() {
        let plain = ["-c:v", "libx264", "-profile:v", "baseline"];
        let x264 = |more: &[&'static str]| [&["-c:v", "libx264", "-bf", "0"][..], more].concat();
        let folder = tempfile::tempdir().unwrap();
        for (n, (name, arguments, is_copied)) in [
            ("film.mp4", plain.to_vec(), true),
            ("film.h264", plain.to_vec(), true),
            ("film.mp4", vec!["-c:v", "mpeg4"], false),
            ("film.mp4", x264(&["-bf", "2"]), false),
            ("film.mp4", x264(&["-vf", "setsar=4/3"]), false),
            ("film.h264", x264(&["-pix_fmt", "yuv422p"]), false),
            ("film.h264", x264(&["-x264-params", "interlaced=1"]), false),
        ]
        .into_iter()
        .enumerate()
        {
            let at = |name: String| folder.path().join(name).to_string_lossy().into_owned();
            let (film, copy) = (at(format!("{n}{name}")), at(format!("{n}copy.h264")));
            let mut command = Command::new("ffmpeg");
            command.args(["-loglevel", "error", "-f", "lavfi", "-i", "testsrc=size=160x120:rate=15:duration=1"]);
            let has_sound = name == "film.mp4";
            if has_sound {
                command.args(["-f", "lavfi", "-i", "sine=duration=1", "-c:a", "aac"]);
            }
            command.args(["-pix_fmt", "yuv420p"]).args(&arguments).arg(&film);
            let Some(status) = Need::Ffmpeg.or_skip(command.status()) else { return };
            assert!(status.success(), "{arguments:?}");
            let (frames, times) = read(&film, InputOptions { transcode: false, sound: true }).await.unwrap();
            // fails for other video
            Command::new("ffmpeg").args(["-loglevel", "quiet", "-i", &film, "-an", "-c:v", "copy", &copy]).status().unwrap();
            let sent: Vec<u8> = frames.iter().flat_map(|f| f.data.to_vec()).collect();
            assert_eq!(std::fs::read(&copy).is_ok_and(|copy| copy == sent), is_copied, "{arguments:?}");
            assert!(frames[0].key && codec(&frames[0].data).is_some() && !frames.iter().any(|f| is_bidirectional(&f.data)));
            assert!((14..=16).contains(&frames.len()), "{} frames with {arguments:?}", frames.len());
            // 50 packets a second; the first ones may come before anyone listens, the last after the last frame
            assert!(times.len() > 10 || !has_sound, "{times:?}");
            assert!(times.windows(2).all(|t| t[1] > t[0]), "{times:?}");
        }
        assert!(read("no/such/film.mp4", InputOptions::default()).await.is_err_and(|e| e.to_string().contains("No such file")));
    }

    #[tokio::test]
    async fn a_rotated_film_is_refused_with_a_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let film = folder.path().join("film.h264").to_string_lossy().into_owned();
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-f", "lavfi", "-i", "testsrc=size=160x120:rate=15:duration=1", "-pix_fmt", "yuv420p"]);
        command.args(["-c:v", "libx264", "-bf", "0", "-bsf:v", "h264_metadata=display_orientation=insert:rotate=90", &film]);
        let Some(status) = Need::Ffmpeg.or_skip(command.status()) else { return };
        assert!(status.success());
        assert!(read(&film, InputOptions::default()).await.is_err_and(|e| e.to_string().contains("transpose")));
    }
}
