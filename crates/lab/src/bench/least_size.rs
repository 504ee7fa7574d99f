//! Sizes that photos are reduced to when memory is short: what views lose, and what bytes they take.

use super::experiments::{KB, VIEW};
use super::measure::{Bench, Depth, Setting};
use super::subject::Subject;
use super::{Curve, Experiment, Figures, Point};
use crate::LabError;
use tmpi_core::{Camera, Pose};
use tmpi_pipeline::photo::{self, Limits};
use tmpi_pipeline::run::memory::MIN_PIXELS;
use tmpi_pipeline::{MakeError, Options, networks};

/// Numbers of pixels that are compared.
const SIZES: [u64; 5] = [750_000, 1_000_000, MIN_PIXELS, 2_000_000, 3_000_000];
/// Most photos that are measured; with `--quick`, fewer.
const PHOTOS: [usize; 2] = [8, 2];

/// `scenes` are larger than all sizes; so are those of the `photos` that are measured.
pub(super) fn run(bench: &Bench, scenes: &[Subject], photos: &[Subject], quick: bool) -> Result<Experiment, LabError> {
    let has_depth = |p: &&Subject| p.disparity.is_some() || networks::available().is_ok();
    let of_itself = photos.iter().filter(has_depth).filter_map(|p| with_own_view(p, SIZES[4]).transpose());
    let of_itself = of_itself.take(PHOTOS[usize::from(quick)]).collect::<Result<Vec<_>, _>>()?;
    let mut curves = vec![curve(bench, "scenes, from aside", scenes, &SIZES)?];
    if !of_itself.is_empty() {
        curves.push(curve(bench, "photos, own view", &of_itself, &SIZES)?);
    }
    Ok(Experiment {
        id: "least-size".into(),
        title: "Least size when memory is short".into(),
        about: "A photo that does not fit into memory is reduced, but not below the default here; one that would have to be smaller is refused. Views are drawn at the photo's original size: of rendered scenes of 3.8 megapixels from aside, against the true views; of photos of more than 3 megapixels, if there are any, from their own place, against the photo.".into(),
        x: KB,
        y: VIEW,
        curves,
    })
}

/// A photo whose exact view is that from its own place: the photo itself. `None` if it has at most so many pixels.
fn with_own_view(p: &Subject, pixels: u64) -> Result<Option<Subject>, LabError> {
    let fail = |e| LabError::Make { subject: p.name.clone(), source: MakeError::Photo(e) };
    let (width, height) = photo::check(&p.file, &Limits::default()).map_err(fail)?.1;
    if u64::from(width) * u64::from(height) <= pixels {
        return Ok(None);
    }
    let decoded = p.decoded()?;
    let (width, height) = (decoded.photo.width, decoded.photo.height);
    let camera = Camera { pose: Pose::default(), intrinsics: decoded.intrinsics, width, height };
    Ok(Some(Subject { views: vec![(camera, decoded.photo)], ..p.clone() }))
}

/// The longest side with which a picture has this number of pixels.
fn side(width: u32, height: u32, pixels: u64) -> u32 {
    let scale = (pixels as f64 / (f64::from(width) * f64::from(height))).sqrt();
    (f64::from(width.max(height)) * scale).round() as u32
}

/// A point for each number of pixels, and one for the size that subjects have.
fn curve(bench: &Bench, name: &str, subjects: &[Subject], sizes: &[u64]) -> Result<Curve, LabError> {
    let (mut all, known) = (vec![Figures::default(); sizes.len() + 1], Depth::Known);
    for s in subjects {
        let Some((Camera { width, height, .. }, _)) = s.views.first() else { continue };
        let reduced = sizes.iter().map(|pixels| Options { max_size: Some(side(*width, *height, *pixels)), ..Options::default() });
        let options: Vec<Options> = reduced.chain([Options::default()]).collect();
        let settings: Vec<Setting> = options.iter().map(|o| (&known, o, 0)).collect();
        let measured = bench.figures(std::slice::from_ref(s), &settings)?;
        all.iter_mut().zip(measured).for_each(|(all, one)| all.append(one));
    }
    let named = sizes.iter().map(|&pixels| (format!("{} MP", pixels as f64 / 1e6), pixels == MIN_PIXELS));
    let points = named.chain([("original size".to_owned(), false)]).zip(all);
    let point = |((words, default), f): ((String, bool), Figures)| Point { default, ..f.point(words, (&KB.label, &VIEW.label)) };
    Ok(Curve { name: name.into(), points: points.map(point).collect() })
}

#[cfg(test)]
mod tests {
    use super::super::measure::REDUCED;
    use super::super::subject;
    use super::*;
    use crate::oracle_depth;

    #[test]
    fn sides_have_the_number_of_pixels() {
        assert_eq!((side(2400, 1600, 1_500_000), side(1600, 2400, 3_840_000), side(100, 100, 2500)), (1500, 2400, 50));
    }

    #[test]
    fn smaller_photos_take_fewer_bytes_and_show_less() {
        let models = oracle_depth::none();
        let bench = Bench { models: &models, repeats: 1 };
        let scene = subject::scene(900_301, (240, 160), &[Pose::at(0.03, 0.0, 0.0)]).unwrap();
        // intrinsics by default, as of a photo
        let photo = Subject { fov_x: None, views: Vec::new(), ..scene.clone() };
        assert!(with_own_view(&photo, 240 * 160).unwrap().is_none());
        let photo = with_own_view(&photo, 240 * 160 - 1).unwrap().unwrap();
        for subject in [scene, photo] {
            let points = curve(&bench, "it", &[subject], &[2_400, 9_600]).unwrap().points;
            assert_eq!(points.iter().map(|p| &*p.setting).collect::<Vec<_>>(), ["0.0024 MP", "0.0096 MP", "original size"]);
            assert!(points.is_sorted_by(|a, b| a.x < b.x && a.y < b.y), "{points:?}");
            let reduced = |p: &Point| p.figures.iter().any(|f| f.0 == REDUCED);
            assert_eq!(points.iter().map(reduced).collect::<Vec<_>>(), [true, true, false]);
        }
    }

    #[test]
    fn the_default_is_marked_once() {
        let models = oracle_depth::none();
        let curve = curve(&Bench { models: &models, repeats: 1 }, "none", &[], &SIZES).unwrap();
        assert_eq!(curve.points.iter().map(|p| p.default).collect::<Vec<_>>(), [false, false, true, false, false, false]);
    }
}
