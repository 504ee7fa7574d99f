//! The files of a photo.

/// A file of a photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Part {
    /// The photo as uploaded.
    Upload,
    /// The user's depth map.
    Depth,
    /// What was accepted.
    Options,
    /// What became of it.
    State,
    /// What its owner wants of viewers.
    Settings,
    /// What a person put right of its depth.
    Strokes,
    /// Report of the way, JSON.
    Report,
    /// The container.
    Atlas,
    /// Disparity as used, 16-bit grey PNG.
    Disparity,
    /// Small JPEG.
    Thumbnail,
}

impl Part {
    /// File name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Depth => "depth",
            Self::Options => "options.json",
            Self::State => "state.json",
            Self::Settings => "settings.json",
            Self::Strokes => "strokes.json",
            Self::Report => "report.json",
            Self::Atlas => "atlas.tmpi",
            Self::Disparity => "depth.png",
            Self::Thumbnail => "thumbnail.jpg",
        }
    }
}
