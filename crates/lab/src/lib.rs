//! Instruments: what tmpi is measured and tested with. No part of the program's work on a photo.
//!
//! [`metrics`] compare pictures; [`scenes`] are rendered with known depth; [`eval`] draws second views and holds them against the truth;
//! [`bench`] reports error against run time, [`live`] that of sequences; [`stress`] runs stiff and extreme cases against plain references.

pub mod bench;
pub mod eval;
pub mod fixed;
pub mod live;
pub mod metrics;
pub mod scenes;
pub mod stress;
