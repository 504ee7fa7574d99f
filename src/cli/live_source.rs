//! Where `tmpi live publish` has its frames from.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use bytes::Bytes;

use tmpi_live::depth;
use tmpi_live::units::{Splitter, Unit};
use tmpi_live::video::{self, JPEG};
use tmpi_pipeline::depth::{self as maps, DepthKind};

use super::live_program::{Program, ffmpeg, is_live};

/// What is sent of a frame.
#[derive(Clone)]
pub(super) struct Frame {
    pub(super) data: Bytes,
    pub(super) key: bool,
    pub(super) depth: Option<Bytes>,
}

/// Frames of a file, a folder or a program.
pub(super) enum Source {
    /// Files of a folder, the next of them, and what depth maps beside them hold.
    Folder(Vec<PathBuf>, usize, DepthKind),
    /// Units that were read, and the next of them.
    Units(Vec<Unit>, usize),
    /// Units that come when they come.
    Program(Program),
}

impl Source {
    /// # Errors
    /// There is no such file, or no frame in it.
    pub(super) fn open(source: &str, depth: DepthKind) -> anyhow::Result<Self> {
        let path = Path::new(source);
        if path.is_dir() {
            let mut files: Vec<PathBuf> = std::fs::read_dir(path)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
            files.retain(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
            files.sort();
            if files.is_empty() {
                bail!("{source} holds no JPEG file");
            }
            return Ok(Self::Folder(files, 0, depth));
        }
        if path.extension().is_some_and(|e| e == "h264" || e == "264") {
            let mut splitter = Splitter::default();
            let mut units = Vec::new();
            for piece in std::fs::read(path).with_context(|| source.to_owned())?.chunks(1 << 16) {
                units.extend(splitter.push(piece)?);
            }
            units.extend(splitter.finish());
            return Ok(Self::Units(units, 0));
        }
        Ok(Self::Program(Program::start(&mut ffmpeg(source), is_live(source))?))
    }

    /// Whether frames come when they come.
    pub(super) const fn is_paced(&self) -> bool {
        matches!(self, Self::Program(_))
    }

    /// Units that were left out as newer ones came.
    pub(super) fn left_out(&self) -> u64 {
        if let Self::Program(program) = self { program.left_out() } else { 0 }
    }

    /// The next frame; none at the end.
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

/// Packs the depth map that lies beside a frame.
fn measured(file: &Path, kind: DepthKind, frame: &[u8]) -> anyhow::Result<Bytes> {
    let name = || file.display().to_string();
    let (width, height) = video::size(JPEG, frame)?;
    let limits = tmpi_pipeline::photo::Limits::default();
    let (map, _) = maps::from_map(&std::fs::read(file).with_context(name)?, kind, &limits, width, height).with_context(name)?;
    Ok(depth::pack(&map)?.into())
}
