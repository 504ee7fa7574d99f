//! How wide the widest mean of colours beyond a photo's borders is: photos are cropped and continued, and compared with what was cropped.

use super::measure::{Bench, in_turns};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Figures, Point};
use crate::{LabError, metrics};
use tmpi_core::{Border, BorderColours, Class, Photo};
use tmpi_pipeline::usage::Clock;

const TIME: &str = "colours beyond the border, ms";
const ERROR: &str = "beyond the border, dB";
/// Pixels that are cropped on each side.
const CROPS: [u32; 3] = [64, 128, 256];
/// Widest means, as powers of two of their side in pixels.
const COARSEST: [usize; 4] = [4, 5, 6, 7];

pub(super) fn run(bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
    let mut all = CROPS.map(|crop| (crop, 0, vec![Figures::default(); COARSEST.len()]));
    for s in subjects {
        let photo = s.decoded()?.photo;
        // what is continued has as many pixels as the mirror image that it colours
        for (crop, photos, figures) in all.iter_mut().filter(|(crop, ..)| photo.width.min(photo.height) >= 3 * *crop) {
            *photos += 1;
            figures.iter_mut().zip(measured(bench, &photo, *crop)?).for_each(|(all, one)| all.append(one));
        }
    }
    let curve = |(crop, photos, figures): (u32, usize, Vec<Figures>)| {
        let point = |(&coarsest, f): (&usize, Figures)| {
            let p = f.point(format!("{0}×{0}", 1 << coarsest), (TIME, ERROR));
            Point { default: coarsest == BorderColours::COARSEST, ..p }
        };
        Curve { name: format!("{crop} px beyond, photos: {photos}"), points: COARSEST.iter().zip(figures).map(point).collect() }
    };
    Ok(Experiment {
        id: "beyond".into(),
        title: "Colours beyond the border".into(),
        about: "Photos, or large rendered scenes if no photos are given, are cropped on each side and continued by means of the colours at the border, over squares of up to so many pixels; these colours are compared with what was cropped. Squares are about half as wide as a pixel is far from the border: widest ones of 16, 32, 64 pixels are reached 30, 62, 126 pixels beyond it, and wider ones make no difference nearer than that. Each curve has the photos that are large enough. Wider means than 64 pixels are for comparison only: readers of a band of rows lack the pixels for them.".into(),
        x: Axis::new(TIME, true, Some(false)),
        y: Axis::new(ERROR, false, Some(true)),
        curves: all.into_iter().filter(|(_, photos, _)| *photos > 0).map(curve).collect(),
    })
}

/// Crops a photo and continues it, with each of the widest means.
fn measured(bench: &Bench, photo: &Photo, crop: u32) -> Result<Vec<Figures>, LabError> {
    let inner = Photo::from_fn(photo.width - 2 * crop, photo.height - 2 * crop, |x, y| photo.at(x + crop, y + crop));
    let want = outside(photo, crop);
    let mut all = vec![Figures::default(); COARSEST.len()];
    in_turns(COARSEST.len(), bench.repeats, |i, round| {
        let clock = Clock::start();
        let colours = BorderColours::with_coarsest(&inner.rgb, [inner.width, inner.height], 0, COARSEST[i]);
        let means = clock.ms();
        let continued = continued(&inner, &colours, crop as usize);
        let ms = clock.ms();
        all[i].add_run(TIME, 0, ms);
        all[i].add_run("means, ms", 0, means);
        if round == 0 {
            let got = outside(&continued, crop);
            all[i].add(ERROR, metrics::psnr(got.as_flattened(), want.as_flattened()));
            all[i].add("compared, % of the photo", 100.0 * want.len() as f64 / photo.rgb.len() as f64);
        }
        Ok(ms)
    })?;
    Ok(all)
}

/// The pixels within `crop` pixels of the border, row by row.
fn outside(photo: &Photo, crop: u32) -> Vec<[u8; 3]> {
    let [columns, rows] = [photo.width, photo.height].map(|side| crop..side - crop);
    let places = (0..photo.height).flat_map(|y| (0..photo.width).map(move |x| (x, y)));
    places.filter(|(x, y)| !(columns.contains(x) && rows.contains(y))).map(|(x, y)| photo.at(x, y)).collect()
}

/// The photo's surroundings, as wide as `crop` on each side, in the colours of visible texels; the photo itself is left black.
fn continued(photo: &Photo, colours: &BorderColours, crop: usize) -> Photo {
    let (width, height) = (photo.width as usize, photo.height as usize);
    let classes = vec![Class::Photo as u8; width];
    let mut rgb = Vec::with_capacity((width + 2 * crop) * (height + 2 * crop));
    for row in 0..height + 2 * crop {
        let (y, vertical) = mirrored(row, crop, height);
        for (columns, horizontal) in [(0..crop, Some(Border::Low)), (0..width, None), (width - crop..width, Some(Border::High))] {
            let mut texels = vec![[0, 0, 0, u8::MAX]; columns.len()];
            if [horizontal, vertical] != [None; 2] {
                colours.recolour((columns.start, y), [horizontal, vertical], &classes[columns], &mut texels);
            }
            if horizontal.is_some() {
                texels.reverse();
            }
            rgb.extend(texels.into_iter().map(|[r, g, b, _]| [r, g, b]));
        }
    }
    Photo { width: (width + 2 * crop) as u32, height: (height + 2 * crop) as u32, rgb }
}

/// The row of the photo that is mirrored at a row of the photo with its surroundings, and the border that is the mirror.
fn mirrored(row: usize, crop: usize, height: usize) -> (usize, Option<Border>) {
    if row < crop {
        (crop - 1 - row, Some(Border::Low))
    } else if row < crop + height {
        (row - crop, None)
    } else {
        (crop + 2 * height - 1 - row, Some(Border::High))
    }
}

#[cfg(test)]
mod tests {
    use super::super::subject;
    use super::*;
    use crate::oracle_depth;

    #[test]
    fn each_side_goes_on_with_its_own_colours() {
        let quarter = |x: u32, y: u32| [if x < 100 { 10 } else { 210 }, if y < 90 { 30 } else { 230 }, 77];
        let photo = Photo::from_fn(200, 180, quarter);
        let whole = continued(&photo, &BorderColours::new(&photo.rgb, [200, 180], 0), 20);
        assert_eq!((whole.width, whole.height), (240, 220));
        for (x, y) in [(0, 0), (239, 0), (0, 219), (239, 219), (40, 0), (200, 219), (0, 40), (239, 180), (19, 100), (220, 120)] {
            let inside = [(x, 200_u32), (y, 180)].map(|(v, side): (u32, u32)| v.saturating_sub(20).min(side - 1));
            assert_eq!(whole.at(x, y), quarter(inside[0], inside[1]), "{x}, {y}");
        }
        assert_eq!((whole.at(20, 20), whole.at(219, 199)), ([0; 3], [0; 3]));
        assert_eq!(outside(&whole, 20).len(), 240 * 220 - 200 * 180);
        assert!(!outside(&whole, 20).contains(&[0; 3]));
    }

    #[test]
    fn rows_are_mirrored_at_the_nearer_border() {
        let (low, high) = (Some(Border::Low), Some(Border::High));
        assert_eq!([0, 2, 3, 12, 13, 15].map(|row| mirrored(row, 3, 10)), [(2, low), (0, low), (0, None), (9, None), (9, high), (7, high)]);
    }

    #[test]
    fn widths_beyond_the_radius_of_the_blur_make_no_difference() {
        let models = oracle_depth::none();
        let scene = subject::scene(900_302, (200, 192), &[]).unwrap();
        let small = subject::scene(900_302, (200, 191), &[]).unwrap();
        let experiment = run(&Bench { models: &models, repeats: 2 }, &[scene, small]).unwrap();
        let [curve] = experiment.curves.as_slice() else { panic!("{:?}", experiment.curves) };
        assert_eq!((curve.name.as_str(), curve.points.len()), ("64 px beyond, photos: 1", COARSEST.len()));
        assert_eq!(curve.points.iter().map(|p| p.default).collect::<Vec<_>>(), [false, false, true, false]);
        assert!(curve.points.iter().all(|p| p.x > 0.0 && (5.0..60.0).contains(&p.y)), "{curve:?}");
        let [narrow, .., usual, wide] = [0, 1, 2, 3].map(|i| curve.points[i].y);
        assert!((usual - wide).abs() < 1e-12 && (narrow - usual).abs() > 1e-9, "{curve:?}");
    }
}
