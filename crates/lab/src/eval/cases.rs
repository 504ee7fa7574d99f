//! Reads photos with true depth and true second views from folders.

use std::path::Path;

use serde::Deserialize;

use super::public_datasets;
use crate::{LabError, files};
use tmpi_core::{Camera, DisparityMap, Intrinsics, Pose, ViewBox};
use tmpi_pipeline::depth::Estimator;

/// Focal length of a stereo pair's cameras, in picture widths; their files do not state it.
pub(super) const FOCAL: f64 = 0.58;

/// A photo, its true disparity, and true views from other positions.
pub(super) struct Case {
    pub name: String,
    /// The photo's file.
    pub photo: Vec<u8>,
    pub intrinsics: Intrinsics,
    /// True disparity; its maximum is 1.
    pub truth: DisparityMap,
    pub views: Vec<Truth>,
}

pub(super) struct Truth {
    pub camera: Camera,
    pub rgb: Vec<[u8; 3]>,
}

impl Case {
    /// The smallest view box around the photo's position that contains all views.
    pub fn view_box(&self) -> ViewBox {
        let most = |f: fn(&Pose) -> f64| self.views.iter().map(|v| f(&v.camera.pose).abs()).fold(0.0, f64::max);
        ViewBox { x: most(|p| p.tx), y: most(|p| p.ty), z: most(|p| p.tz) }
    }
}

/// Reads the scene in a folder, and those in the folders in it, sorted by name:
///
/// - Scenes that `tmpi-lab synth --views N` wrote.
/// - Rectified stereo pairs: `left.png`, `right.png`, `disp_left.png` and `meta.json` with `scale`. A value of `disp_left.png` divided by
///   `scale` is in pixels; 0 is unknown.
/// - Whatever [`public_datasets::of`] reads.
pub(super) fn read(folder: &Path, depth: &dyn Estimator) -> Result<Vec<Case>, LabError> {
    let mut cases = of(folder, depth)?;
    for f in files::entries(folder)?.iter().filter(|f| f.is_dir()) {
        cases.extend(of(f, depth)?);
    }
    if cases.is_empty() {
        let reason = "neither it nor a folder below it holds a scene of `tmpi-lab synth`, a stereo pair, a light field or a sequence";
        return Err(LabError::file(folder, reason));
    }
    Ok(cases)
}

/// Scenes whose files lie in the folder itself.
fn of(folder: &Path, depth: &dyn Estimator) -> Result<Vec<Case>, LabError> {
    if folder.join("scene.json").exists() {
        Ok(vec![rendered(folder)?])
    } else if folder.join("disp_left.png").exists() {
        Ok(vec![pair(folder)?])
    } else {
        public_datasets::of(folder, depth)
    }
}

#[derive(Deserialize)]
struct About {
    intrinsics: Intrinsics,
    views: Vec<AboutView>,
}

#[derive(Deserialize)]
struct AboutView {
    photo: String,
    pose: Pose,
}

fn rendered(folder: &Path) -> Result<Case, LabError> {
    let about: About = files::read_json(&folder.join("scene.json"))?;
    let photo = files::read(&folder.join("photo.png"))?;
    let (width, height, delta) = map(&folder.join("disparity.png"))?;
    let mut views = Vec::new();
    for v in &about.views {
        let path = folder.join(&v.photo);
        let rgb = picture(&path, width, height)?;
        views.push(Truth { camera: Camera { pose: v.pose, intrinsics: about.intrinsics, width, height }, rgb });
    }
    if views.is_empty() {
        return Err(LabError::file(&folder.join("scene.json"), "has no views; `tmpi-lab synth --views N` writes some"));
    }
    let delta = delta.iter().map(|v| (v / 65_535.0) as f32).collect();
    Ok(Case { name: files::name(folder), photo, intrinsics: about.intrinsics, truth: DisparityMap { width, height, delta }, views })
}

#[derive(Deserialize)]
struct Meta {
    scale: f64,
}

fn pair(folder: &Path) -> Result<Case, LabError> {
    let meta: Meta = files::read_json(&folder.join("meta.json"))?;
    let photo = files::read(&folder.join("left.png"))?;
    let path = folder.join("disp_left.png");
    let (width, height, raw) = map(&path)?;
    let mut pixels: Vec<f64> = raw.iter().map(|v| v / meta.scale).collect();
    pixels.chunks_mut(width as usize).for_each(complete);
    let most = pixels.iter().copied().fold(0.0, f64::max);
    if !(most > 0.0 && most.is_finite()) {
        return Err(LabError::file(&path, "knows no disparity"));
    }
    let intrinsics = Intrinsics::centred(width, height, FOCAL * f64::from(width));
    let camera = Camera { pose: Pose::at(most / intrinsics.fx, 0.0, 0.0), intrinsics, width, height };
    let rgb = picture(&folder.join("right.png"), width, height)?;
    let delta = pixels.iter().map(|p| (p / most) as f32).collect();
    Ok(Case {
        name: files::name(folder),
        photo,
        intrinsics,
        truth: DisparityMap { width, height, delta },
        views: vec![Truth { camera, rgb }],
    })
}

/// Fills unknown values (0) of a row with the farther of the two known neighbours: what only one camera sees lies behind.
pub(super) fn complete(row: &mut [f64]) {
    let known: Vec<(usize, f64)> = row.iter().copied().enumerate().filter(|(_, d)| *d > 0.0).collect();
    let mut next = 0usize;
    for x in 0..row.len() {
        if row[x] > 0.0 {
            next += 1;
            continue;
        }
        let around = [next.checked_sub(1).map(|i| known[i].1), known.get(next).map(|k| k.1)];
        row[x] = around.into_iter().flatten().reduce(f64::min).unwrap_or(0.0);
    }
}

/// Values of a grey picture, as in the file.
pub(super) fn map(path: &Path) -> Result<(u32, u32, Vec<f64>), LabError> {
    let decoded = image::open(path).map_err(|e| LabError::file(path, e))?;
    let (width, height) = (decoded.width(), decoded.height());
    let values = match decoded {
        image::DynamicImage::ImageLuma16(grey) => grey.iter().map(|v| f64::from(*v)).collect(),
        other => other.to_luma8().iter().map(|v| f64::from(*v)).collect(),
    };
    Ok((width, height, values))
}

pub(super) fn picture(path: &Path, width: u32, height: u32) -> Result<Vec<[u8; 3]>, LabError> {
    let decoded = image::open(path).map_err(|e| LabError::file(path, e))?.into_rgb8();
    if (decoded.width(), decoded.height()) != (width, height) {
        return Err(LabError::file(path, format!("must be {width}×{height} pixels, as the disparity")));
    }
    Ok(decoded.pixels().map(|p| p.0).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle_depth;

    #[test]
    fn unknown_disparities_are_those_of_what_lies_behind() {
        let mut row = [0.0, 3.0, 0.0, 0.0, 5.0, 0.0];
        complete(&mut row);
        assert!(row.iter().zip([3.0, 3.0, 3.0, 3.0, 5.0, 5.0]).all(|(a, b): (&f64, f64)| a.total_cmp(&b).is_eq()), "{row:?}");
        let mut row = [0.0; 3];
        complete(&mut row);
        assert!(row.iter().all(|d: &f64| d.abs() <= 0.0), "{row:?}");
    }

    #[test]
    fn a_pair_is_read_and_its_largest_disparity_is_one() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("a");
        std::fs::create_dir(&scene).unwrap();
        let grey = image::GrayImage::from_fn(8, 6, |x, _| image::Luma([if x < 4 { 40 } else { 0 }]));
        let rgb = image::RgbImage::from_fn(8, 6, |x, y| image::Rgb([x as u8, y as u8, 7]));
        grey.save(scene.join("disp_left.png")).unwrap();
        rgb.save(scene.join("left.png")).unwrap();
        rgb.save(scene.join("right.png")).unwrap();
        std::fs::write(scene.join("meta.json"), r#"{"scale": 20}"#).unwrap();
        // depth of this pair is not measured
        let none = oracle_depth::none().depth;
        let [cases, own] = [folder.path(), &scene].map(|from| read(from, none.as_ref()).unwrap());
        assert_eq!((cases.len(), own.len()), (1, 1));
        assert!(cases[0].truth.delta.iter().all(|d| (*d - 1.0).abs() < 1e-6));
        // two pixels of shift for the nearest
        let camera = &cases[0].views[0].camera;
        assert!((camera.pose.tx * camera.intrinsics.fx - 2.0).abs() < 1e-12);
        assert_eq!(cases[0].views[0].rgb[9], [1, 1, 7]);
        let empty = tempfile::tempdir().unwrap();
        assert!(read(empty.path(), none.as_ref()).is_err_and(|e| e.to_string().contains("stereo pair")));
    }
}
