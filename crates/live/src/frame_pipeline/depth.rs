//! Estimates a frame's depth.

use tmpi_core::{DisparityMap, Photo, Rect};
use tmpi_pipeline::MakeError;
use tmpi_pipeline::run::Context;
use tmpi_pipeline::run::stages::{Source, WeightedDisparity, find_disparity, remove_noise, snap_to_video};

use super::Frame;

/// Radius in pixels that snapping reads, over its three passes.
const SNAP_REACH: u32 = 8;

/// Returns a frame's disparity. It is measured and denoised, or estimated by the network at `size`. Its ramps are snapped; in an estimate
/// only those in `part`, if there is one.
pub(super) fn estimate(
    job: &mut Context,
    frame: &Frame,
    size: Option<(u32, u32)>,
    part: Option<Rect>,
) -> Result<WeightedDisparity, MakeError> {
    if let Some(given) = &frame.depth {
        let map = WeightedDisparity { delta: given.clone(), confidence: None, given: true };
        let map = remove_noise(job, &frame.photo, map)?;
        return snap_to_video(job, &frame.photo, map);
    }
    let map = find_disparity(job, &frame.photo, Source::Network, size)?;
    match part {
        Some(part) => snap_part(job, &frame.photo, map, part),
        None => snap_to_video(job, &frame.photo, map),
    }
}

/// Snaps the ramps in a part of a map, with the same result there as snapping all of it.
pub(super) fn snap_part(job: &mut Context, photo: &Photo, mut map: WeightedDisparity, part: Rect) -> Result<WeightedDisparity, MakeError> {
    let width = photo.width as usize;
    let (x0, y0) = (part.x.saturating_sub(SNAP_REACH), part.y.saturating_sub(SNAP_REACH));
    let (x1, y1) = ((part.x + part.w + SNAP_REACH).min(photo.width), (part.y + part.h + SNAP_REACH).min(photo.height));
    let (w, h) = (x1 - x0, y1 - y0);
    let rows = || (y0..y1).map(|y| y as usize * width + x0 as usize);
    let rgb = rows().flat_map(|at| &photo.rgb[at..at + w as usize]).copied().collect();
    let delta = rows().flat_map(|at| &map.delta.delta[at..at + w as usize]).copied().collect();
    let cut = WeightedDisparity { delta: DisparityMap { width: w, height: h, delta }, confidence: None, given: map.given };
    let snapped = snap_to_video(job, &Photo { width: w, height: h, rgb }, cut)?;
    for y in part.y..part.y + part.h {
        let (to, from) = ((y as usize * width) + part.x as usize, ((y - y0) * w + part.x - x0) as usize);
        let count = part.w as usize;
        map.delta.delta[to..to + count].copy_from_slice(&snapped.delta.delta[from..from + count]);
    }
    Ok(map)
}
