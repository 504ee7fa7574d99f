//! Reads photos with true second views in the formats of public data: light fields, frames of a moving depth camera, and pictures of two
//! eyes.

use std::path::Path;

use image::ExtendedColorType;
use serde::Deserialize;

use super::cases::{Case, FOCAL, Truth, map, picture};
use super::decoded;
use crate::{LabError, files};
use tmpi_core::{Camera, DisparityMap, Intrinsics, Mat3, Photo, Pose, mat3_vec};
use tmpi_pipeline::depth::Estimator;
use tmpi_pipeline::photo::{Limits, decode};
use tmpi_pipeline::stereo::census::Grey;
use tmpi_pipeline::stereo::{Halves, measure, rectify};
use tmpi_testing::pictures::png;

/// Maximum side of an eye's picture, in pixels.
const EYE: u32 = 960;
/// Number of frames of a sequence that serve as the photo.
const REFERENCES: usize = 6;
/// Parallax of the frames to compare with: how far the nearest surface moves, as shares of the width. [`MISSED`] is the tolerance, relative
/// to the parallax.
const PARALLAX: [f64; 4] = [0.01, 0.03, 0.05, 0.08];
const MISSED: f64 = 0.3;
/// Maximum rotation of such a frame, in degrees.
const TURNED: f64 = 6.0;
/// Quantile of a frame's depths that counts as the nearest depth.
const NEAREST: f64 = 0.005;

/// Reads the cases in the folder itself; none if it holds none of these:
///
/// - `cameras.json`, for a light field: parallel cameras with `file`, their distances `a_mm` down and `b_mm` right of the centre camera,
///   and their focal length in picture widths. Views are those above, to the left, and both.
/// - `camera-intrinsics.txt`, with `frame-N.color.jpg`, `frame-N.depth.png` (mm, 0 and 65535 unknown) and `frame-N.pose.txt` (camera to
///   world).
/// - `NAME-left.jpg` with `NAME-right.jpg`, and `NAME.left-right.jpg`: the pictures of two eyes.
///
/// Without true depth, this measures depth from two of the pictures, and `depth` fills what either of them hides.
pub(super) fn of(folder: &Path, depth: &dyn Estimator) -> Result<Vec<Case>, LabError> {
    if folder.join("cameras.json").exists() {
        return Ok(vec![light_field(folder, depth)?]);
    }
    if folder.join("camera-intrinsics.txt").exists() {
        return sequence(folder);
    }
    let mut cases = Vec::new();
    for path in files::entries(folder)? {
        let file = files::name(&path);
        if let Some(name) = file.strip_suffix("-left.jpg") {
            let second = files::read(&path.with_file_name(format!("{name}-right.jpg")))?;
            cases.extend(eyes(name, &eye(&files::read(&path)?, &path)?, &eye(&second, &path)?, depth)?);
        } else if let Some(name) = file.strip_suffix(".left-right.jpg") {
            let both = decode(&files::read(&path)?, &Limits::default(), Some(2 * EYE)).map_err(|e| LabError::file(&path, e))?.photo;
            if let Some((first, second)) = Halves::LeftRight.split(&both) {
                cases.extend(eyes(name, &first, &second, depth)?);
            }
        }
    }
    Ok(cases)
}

fn eye(file: &[u8], path: &Path) -> Result<Photo, LabError> {
    decode(file, &Limits::default(), Some(EYE)).map(|d| d.photo).map_err(|e| LabError::file(path, e))
}

/// Depth of a photo, measured against a second picture on the same rows.
struct Measured {
    map: DisparityMap,
    /// How much farther left δ = 1 is than δ = 0 in the second picture, in pixels; negative if that picture is the left eye's.
    span: f64,
    /// How much farther left δ = 0 is in the second picture, in pixels.
    infinity: f64,
}

/// Measures depth; `None` if the pictures do not allow it.
fn measured(photo: &Photo, second: &Photo, depth: &dyn Estimator) -> Result<Option<Measured>, LabError> {
    let Ok(measured) = measure(photo, second) else { return Ok(None) };
    let joined = measured.fuse(photo, &depth.estimate(photo)?);
    let f = joined.figures;
    let side = if f.crossed { -1.0 } else { 1.0 };
    Ok(Some(Measured { map: joined.map, span: side * (f.nearest_px - f.infinity_px), infinity: side * f.infinity_px }))
}

impl Measured {
    /// The camera at these multiples of the distance to the second picture, right and down.
    fn camera(&self, intrinsics: Intrinsics, (right, down): (f64, f64)) -> Camera {
        let k = intrinsics;
        let pose = Pose::at(right * self.span / k.fx, down * self.span / k.fy, 0.0);
        let intrinsics = Intrinsics { cx: k.cx - right * self.infinity, cy: k.cy - down * self.infinity, ..k };
        Camera { pose, intrinsics, width: self.map.width, height: self.map.height }
    }
}

#[derive(Deserialize)]
struct LightField {
    focal_over_width: f64,
    cameras: Vec<Place>,
}

#[derive(Deserialize)]
struct Place {
    file: String,
    a_mm: f64,
    b_mm: f64,
}

fn light_field(folder: &Path, depth: &dyn Estimator) -> Result<Case, LabError> {
    let path = folder.join("cameras.json");
    let bad = |reason: &str| LabError::file(&path, reason);
    let LightField { focal_over_width, cameras } = files::read_json(&path)?;
    let middle =
        cameras.iter().min_by(|a, b| a.a_mm.hypot(a.b_mm).total_cmp(&b.a_mm.hypot(b.b_mm))).ok_or_else(|| bad("names no camera"))?;
    let photo = files::read(&folder.join(&middle.file))?;
    let reference = decoded(&photo, &folder.join(&middle.file))?;
    let (width, height) = (reference.width, reference.height);
    let views: Vec<&Place> = cameras.iter().filter(|c| c.a_mm <= 0.0 && c.b_mm <= 0.0 && c.a_mm + c.b_mm < 0.0).collect();
    // far enough to the side for exact depth, near enough to see most of the photo
    let mut aside: Vec<&Place> = views.iter().copied().filter(|c| c.a_mm >= 0.0).collect();
    aside.sort_by(|a, b| b.b_mm.total_cmp(&a.b_mm));
    let second = aside.get(aside.len() / 2).ok_or_else(|| bad("has no camera beside the middle one"))?;
    let beside = Photo { width, height, rgb: picture(&folder.join(&second.file), width, height)? };
    let measured = measured(&reference, &beside, depth)?.filter(|m| m.span < 0.0).ok_or_else(|| bad("its depth cannot be measured"))?;
    let intrinsics = Intrinsics::centred(width, height, focal_over_width * f64::from(width));
    let truth = |place: &&Place| {
        let rgb = picture(&folder.join(&place.file), width, height)?;
        // the span is that of a camera to the left
        let way = |mm: f64| mm / second.b_mm;
        Ok(Truth { camera: measured.camera(intrinsics, (way(place.b_mm), way(place.a_mm))), rgb })
    };
    let views = views.iter().map(truth).collect::<Result<_, LabError>>()?;
    Ok(Case { name: files::name(folder), photo, intrinsics, truth: measured.map.clone(), views })
}

/// Builds a case from the pictures of two eyes; `None` if they do not allow a measurement of depth.
fn eyes(name: &str, first: &Photo, second: &Photo, depth: &dyn Estimator) -> Result<Option<Case>, LabError> {
    let second = on_rows(first, second);
    let Some(measured) = measured(first, &second, depth)? else { return Ok(None) };
    let (width, height) = (first.width, first.height);
    let intrinsics = Intrinsics::centred(width, height, FOCAL * f64::from(width));
    let photo = png(width, height, first.rgb.as_flattened(), ExtendedColorType::Rgb8);
    let views = vec![Truth { camera: measured.camera(intrinsics, (1.0, 0.0)), rgb: second.rgb }];
    Ok(Some(Case { name: name.into(), photo, intrinsics, truth: measured.map, views }))
}

/// Rectifies the second picture to the rows of the first.
fn on_rows(first: &Photo, second: &Photo) -> Photo {
    let channel =
        |p: &Photo, c: usize| Grey { width: p.width as usize, height: p.height as usize, values: p.rgb.iter().map(|v| v[c]).collect() };
    // green is nearly as bright as all channels together
    let model = rectify::rectify(&channel(first, 1), &channel(second, 1)).unwrap_or_default().model;
    let [r, g, b] = [0, 1, 2].map(|c| model.rectified(&channel(second, c)).values);
    let rgb = r.into_iter().zip(g).zip(b).map(|((r, g), b)| [r, g, b]).collect();
    Photo { width: second.width, height: second.height, rgb }
}

/// A frame of a sequence: position and orientation of its camera.
struct Frame {
    name: String,
    /// Rotation from camera to world.
    orientation: Mat3,
    place: [f64; 3],
}

impl Frame {
    fn read(path: &Path) -> Result<Self, LabError> {
        let m = numbers(path, 16)?;
        let row = |i: usize| [m[4 * i], m[4 * i + 1], m[4 * i + 2]];
        let file = files::name(path);
        let name = file.strip_suffix(".pose.txt").unwrap_or(&file).to_owned();
        Ok(Self { name, orientation: [row(0), row(1), row(2)], place: [m[3], m[7], m[11]] })
    }

    /// Pose of another frame in the coordinates of this frame's camera; lengths are in units of `nearest` metres.
    fn pose_of(&self, other: &Self, nearest: f64) -> Pose {
        let transposed: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| self.orientation[j][i]));
        let way: [f64; 3] = std::array::from_fn(|i| other.place[i] - self.place[i]);
        let [tx, ty, tz] = mat3_vec(&transposed, way).map(|v| v / nearest);
        let columns: Mat3 = std::array::from_fn(|j| mat3_vec(&transposed, std::array::from_fn(|i| other.orientation[i][j])));
        angles(Pose::at(tx, ty, tz), &columns)
    }
}

/// `place` with the angles of an orientation, given by its columns.
fn angles(place: Pose, columns: &Mat3) -> Pose {
    let at = |row: usize, column: usize| columns[column][row];
    let pitch = (-at(1, 2)).clamp(-1.0, 1.0).asin().to_degrees();
    Pose { yaw: at(0, 2).atan2(at(2, 2)).to_degrees(), pitch, roll: at(1, 0).atan2(at(1, 1)).to_degrees(), ..place }
}

fn sequence(folder: &Path) -> Result<Vec<Case>, LabError> {
    let k = numbers(&folder.join("camera-intrinsics.txt"), 9)?;
    let intrinsics = Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    let poses = files::entries(folder)?.into_iter().filter(|p| p.to_string_lossy().ends_with(".pose.txt"));
    let frames = poses.map(|p| Frame::read(&p)).collect::<Result<Vec<_>, _>>()?;
    let step = (frames.len() / REFERENCES).max(1);
    let mut cases = Vec::new();
    for reference in frames.iter().step_by(step).take(REFERENCES) {
        cases.extend(case_of(folder, intrinsics, reference, &frames)?);
    }
    Ok(cases)
}

/// Builds a case from a reference frame; `None` if no other frame is close enough.
fn case_of(folder: &Path, intrinsics: Intrinsics, reference: &Frame, frames: &[Frame]) -> Result<Option<Case>, LabError> {
    let colours = |frame: &Frame| folder.join(format!("{}.color.jpg", frame.name));
    let photo = files::read(&colours(reference))?;
    let path = folder.join(format!("{}.depth.png", reference.name));
    let (width, height, depth) = map(&path)?;
    let known = |mm: &f64| (1.0..65_535.0).contains(mm);
    let mut all: Vec<f64> = depth.iter().copied().filter(known).collect();
    all.sort_by(f64::total_cmp);
    let Some(nearest) = all.get((all.len() as f64 * NEAREST) as usize).map(|mm| mm / 1e3) else {
        return Err(LabError::file(&path, "knows no depth"));
    };
    let mut delta: Vec<f64> = depth.iter().map(|mm| if known(mm) { (1e3 * nearest / mm).min(1.0) } else { 0.0 }).collect();
    delta.chunks_mut(width as usize).for_each(super::cases::complete);
    let truth = DisparityMap { width, height, delta: delta.iter().map(|d| *d as f32).collect() };
    let cameras = chosen(reference, frames, nearest, intrinsics.fx / f64::from(width));
    let view = |(pose, frame): (Pose, &Frame)| {
        let rgb = picture(&colours(frame), width, height)?;
        Ok(Truth { camera: Camera { pose, intrinsics, width, height }, rgb })
    };
    let views = cameras.into_iter().map(view).collect::<Result<Vec<_>, LabError>>()?;
    let case = Case { name: format!("{} {}", files::name(folder), reference.name), photo, intrinsics, truth, views };
    Ok(Some(case).filter(|c| !c.views.is_empty()))
}

/// For each of [`PARALLAX`], the frame that comes closest to it, if one is within the tolerance; `focal` is in picture widths.
fn chosen<'a>(reference: &Frame, frames: &'a [Frame], nearest: f64, focal: f64) -> Vec<(Pose, &'a Frame)> {
    let straight = |p: &Pose| p.yaw.abs().max(p.pitch.abs()).max(p.roll.abs()) < TURNED;
    let poses: Vec<(Pose, &Frame)> = frames.iter().map(|f| (reference.pose_of(f, nearest), f)).filter(|(p, _)| straight(p)).collect();
    let missed = |wanted: f64, p: &Pose| (focal * p.tx.hypot(p.ty).hypot(p.tz) / wanted - 1.0).abs();
    let one = |wanted: f64| {
        poses.iter().min_by(|a, b| missed(wanted, &a.0).total_cmp(&missed(wanted, &b.0))).filter(|p| missed(wanted, &p.0) < MISSED)
    };
    PARALLAX.iter().filter_map(|wanted| one(*wanted).copied()).collect()
}

/// Reads exactly `count` numbers from a text file, separated by white space.
fn numbers(path: &Path, count: usize) -> Result<Vec<f64>, LabError> {
    let text = files::read(path)?;
    let all: Vec<f64> = String::from_utf8_lossy(&text).split_whitespace().filter_map(|v| v.parse().ok()).collect();
    if all.len() == count { Ok(all) } else { Err(LabError::file(path, format!("holds no {count} numbers"))) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_seen_from_another_as_its_pose_says() {
        let frame = |pose: Pose| Frame { name: String::new(), orientation: pose.orientation(), place: [pose.tx, pose.ty, pose.tz] };
        let here = Pose { yaw: 30.0, pitch: -20.0, roll: 10.0, ..Pose::at(1.0, 2.0, 3.0) };
        let seen = Pose { yaw: 4.0, pitch: 3.0, roll: -5.0, ..Pose::at(0.1, -0.2, 0.05) };
        // the same pose, moved and turned as the camera sees it
        let (o, s) = (here.orientation(), seen.orientation());
        let way = mat3_vec(&o, [seen.tx, seen.ty, seen.tz]);
        let there = Frame {
            name: String::new(),
            orientation: std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| o[i][k] * s[k][j]).sum())),
            place: [here.tx + way[0], here.ty + way[1], here.tz + way[2]],
        };
        let got = frame(here).pose_of(&there, 0.5);
        let pairs = [(got.tx, 0.2), (got.ty, -0.4), (got.tz, 0.1), (got.yaw, 4.0), (got.pitch, 3.0), (got.roll, -5.0)];
        assert!(pairs.iter().all(|(a, b)| (a - b).abs() < 1e-9), "{got:?}");
    }

    #[test]
    fn a_measured_pair_is_seen_where_it_was_measured() {
        let map = DisparityMap { width: 100, height: 60, delta: vec![0.0; 6000] };
        let k = Intrinsics::centred(100, 60, 80.0);
        let camera = Measured { map, span: 12.0, infinity: -3.0 }.camera(k, (1.0, 0.0));
        // δ of 1 is 9 pixels farther to the left, δ of 0 three to the right
        for (delta, moved) in [(1.0, -9.0), (0.0, 3.0)] {
            let h = tmpi_core::homography([0.0, 0.0, delta], &k, &camera);
            let p = h.map(|row| row[0] * 12.5 + row[1] * 44.5 + row[2]);
            assert!((p[0] / p[2] - 12.5 - moved).abs() < 1e-9 && (p[1] / p[2] - 44.5).abs() < 1e-9);
        }
    }

    #[test]
    fn frames_are_chosen_by_how_far_the_nearest_thing_moves() {
        let at = |x: f64| Frame { name: x.to_string(), orientation: Pose::default().orientation(), place: [x, 0.0, 0.0] };
        let frames: Vec<Frame> = [0.0, 0.011, 0.03, 0.045, 0.2].map(at).into();
        let turned = Frame { orientation: Pose { yaw: 10.0, ..Pose::default() }.orientation(), ..at(0.08) };
        let all: Vec<Frame> = frames.into_iter().chain([turned]).collect();
        let found: Vec<String> = chosen(&at(0.0), &all, 1.0, 1.0).into_iter().map(|(_, f)| f.name.clone()).collect();
        assert_eq!(found, ["0.011", "0.03", "0.045"]);
    }
}
