//! Cleaning of the disparity map before planes are placed: local planes where noise is measured, the median and guided filter of the
//! comparison, and the confidence network Θ (paper, section 3.2).

pub mod guided_filter;
pub mod local_planes;
pub mod median_guided;
pub mod theta;
