//! Measures and tests what tmpi does, by the program `tmpi-lab` and by tests. The program `tmpi` links nothing of it.
//!
//! [`metrics`] compare pictures; [`scenes`] are rendered with known depth; [`eval`] draws second views and holds them against the truth;
//! [`bench`] reports error against run time, [`live`] that of sequences; [`stress`] runs stiff and extreme cases against plain references.

pub mod bench;
pub mod eval;
pub mod ghosts;
pub mod live;
pub mod metrics;
pub mod oracle;
pub mod scenes;
pub mod stress;
