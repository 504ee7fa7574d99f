//! Cleans the disparity map before planes are placed: local planes where noise is measured, a median with a guided filter as the
//! baseline, and the confidence network Θ (paper, section 3.2).

pub mod guided_filter;
pub mod local_planes;
pub mod median_guided;
pub mod theta;
