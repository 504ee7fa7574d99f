//! Turns a photo into the container of a tiled multiplane image (paper, sections 3 and 4):
//! [`photo`] → [`depth`] → [`denoise`] → [`edges`] → [`planes`] → [`layers`] → container. [`run`] drives these stages.

pub mod denoise;
pub mod depth;
pub mod edges;
mod error;
pub mod layers;
pub mod networks;
pub mod photo;
pub mod planes;
pub mod run;
pub mod stereo;
pub mod strokes;
pub mod usage;

pub use error::StageError;
pub use run::{
    Budget, Bytes, Denoise, ErrorFigures, Input, InputDepth, LeftOut, Made, MakeError, Models, Options, Parallax, ParallaxShift,
    PlaneCount, PlaneError, PlaneMethod, Progress, PruneError, Reduction, Report, STAGES, Silent, Sink, Sizes, StageTime, Switch, TileSize,
    make,
};
pub use stereo::Stereo;
