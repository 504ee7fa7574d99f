//! Measures and tests tmpi. The program `tmpi` does not link it.
//!
//! [`cli`] is the program `tmpi-lab`; the other public modules are what tests and benchmarks use. [`metrics`] compares pictures, and
//! [`scenes`] renders scenes with known depth. `eval` compares second views with the truth. `bench` reports error against run time, and `live`
//! does so for sequences. `conformance` checks stiff and extreme cases against plain references.

mod bench;
pub mod cli;
mod conformance;
mod error;
mod eval;
mod files;
mod ghosts;
mod live;
pub mod metrics;
pub mod oracle_depth;
pub mod scenes;
mod table;

pub use conformance::scenes as stiff_scenes;
use error::LabError;
