//! Measures and tests tmpi. The program `tmpi-lab` and tests use it; the program `tmpi` does not link it.
//!
//! [`metrics`] compares pictures, and [`scenes`] renders scenes with known depth. [`eval`] compares second views with the truth. [`bench`]
//! reports error against run time, and [`live`] does so for sequences. [`conformance`] checks stiff and extreme cases against plain references.

pub mod bench;
pub mod conformance;
mod error;
pub mod eval;
pub mod files;
pub mod ghosts;
pub mod live;
pub mod metrics;
pub mod oracle_depth;
pub mod scenes;
pub mod table;

pub use error::LabError;
