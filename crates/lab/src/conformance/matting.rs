//! Pixels beside depth borders, taken apart: against shares and colours that are known, since the photos are mixed of them.

use tmpi_core::container::{PhotoFormat, decode_picture, encode_jpeg};
use tmpi_core::{Class, Geometry, MATTE_BAND, Photo, Plane, TexturedLayer, compose, texture};
use tmpi_render::draw_reference_view;
use tmpi_testing::pictures::noise;

use super::Checked;
use super::readers::geometry;

const WIDTH: u32 = 150;
const HEIGHT: u32 = 100;
/// Quality of the picture with blocks.
const BLOCKS: u8 = 25;

pub(super) fn run(checked: &mut Checked) {
    cases(checked, |photo, geometry| texture(photo, geometry, geometry.masks()));
}

/// A thing before a wall: where its labels are, its share of each pixel in 0 to 1, and the colours of both.
struct Subject {
    name: &'static str,
    near: fn(u32, u32) -> bool,
    share: fn(u32, u32) -> f64,
    thing: fn(u32, u32) -> [f64; 3],
    wall: fn(u32, u32) -> [f64; 3],
    /// Bound of the error of a share, in 255ths; none where none is known.
    bound: Option<f64>,
    blocks: bool,
}

fn square(x: u32, y: u32) -> bool {
    (40..110).contains(&x) && (30..70).contains(&y)
}

/// Pixels outside of the square.
fn outside(x: u32, y: u32) -> u32 {
    let off = |v: u32, from: u32, to: u32| if v < from { from - v } else { (v + 1).saturating_sub(to) };
    off(x, 40, 110).max(off(y, 30, 70))
}

/// An outline two pixels wide.
fn soft(x: u32, y: u32) -> f64 {
    (1.0 - f64::from(outside(x, y)) / 3.0).max(0.0)
}

/// A wall that is brighter beside the square.
fn halo(x: u32, y: u32) -> [f64; 3] {
    LIGHT(x, y).map(|v| if (1..3).contains(&outside(x, y)) { v + 30.0 } else { v })
}

/// Noise of 0 to 255.
fn rough(x: u32, y: u32, k: u32) -> f64 {
    255.0 * f64::from(noise(x, y + 1000 * k))
}

const DARK: fn(u32, u32) -> [f64; 3] = |_, _| [20.0, 40.0, 60.0];
const LIGHT: fn(u32, u32) -> [f64; 3] = |_, _| [220.0, 210.0, 190.0];

fn subjects() -> Vec<Subject> {
    let sharp: fn(u32, u32) -> f64 = |x, y| f64::from(u8::from(square(x, y)));
    let usual = Subject { name: "a soft outline", near: square, share: soft, thing: DARK, wall: LIGHT, bound: Some(2.0), blocks: false };
    let line: fn(u32, u32) -> bool = |x, _| x % 9 == 4;
    let wide: fn(u32, u32) -> bool = |x, _| (70..72).contains(&x);
    vec![
        Subject { name: "foreground and background alike", thing: LIGHT, bound: None, ..usual },
        Subject { name: "shares of 0 alone", share: sharp, ..usual },
        // the labels end two pixels within the thing
        Subject { name: "shares of 1 alone", share: |x, y| f64::from(u8::from(outside(x, y) <= 2)), ..usual },
        Subject { name: "black before white", thing: |_, _| [0.0; 3], wall: |_, _| [255.0; 3], ..usual },
        Subject { name: "a band wider than the thing", near: wide, share: |x, _| f64::from(u8::from((70..72).contains(&x))), ..usual },
        Subject { name: "lines of one pixel", near: line, share: |x, _| f64::from(u8::from(x % 9 == 4)), ..usual },
        // each share is off by as much as its pixel is, along the line between both colours
        Subject { name: "a rough wall", wall: |x, y| [0, 1, 2].map(|k| 180.0 + rough(x, y, k) / 16.0), bound: Some(24.0), ..usual },
        Subject {
            name: "noise",
            thing: |x, y| [0, 1, 2].map(|k| rough(x, y, k)),
            wall: |x, y| [3, 4, 5].map(|k| rough(x, y, k)),
            bound: None,
            ..usual
        },
        // as sharpening leaves it
        Subject { name: "a halo", share: sharp, wall: halo, bound: None, ..usual },
        Subject { name: "JPEG blocks", bound: Some(70.0), blocks: true, ..usual },
    ]
}

impl Subject {
    fn photo(&self) -> Photo {
        let pixel = |x: u32, y: u32| {
            let (share, [thing, wall]) = ((self.share)(x, y), [(self.thing)(x, y), (self.wall)(x, y)]);
            std::array::from_fn(|c| (thing[c] * share + wall[c] * (1.0 - share)).round() as u8)
        };
        let photo = Photo::from_fn(WIDTH, HEIGHT, pixel);
        let coded = || {
            let bytes = encode_jpeg(WIDTH, HEIGHT, photo.rgb.as_flattened(), BLOCKS).ok()?;
            decode_picture(PhotoFormat::Jpeg, &bytes, (WIDTH, HEIGHT)).ok()
        };
        if self.blocks { coded().unwrap_or_default() } else { photo }
    }

    fn geometry(&self) -> Geometry {
        let near = |x, y| u8::from((self.near)(x, y));
        let planes = [0.25, 0.75].map(Plane::fronto_parallel);
        Geometry { matte_band: MATTE_BAND, ..geometry((WIDTH, HEIGHT), 64, &planes, near) }
    }

    /// The greatest difference of the wall's colours from [`LIGHT`], in levels, where no thing lies on it.
    fn off_wall(&self, photo: &Photo, tiles: &[Vec<TexturedLayer>]) -> f64 {
        let mut most = 0.0_f64;
        for TexturedLayer { shape, hidden } in tiles.iter().flatten().filter(|l| l.shape.plane.a < 0.5) {
            let mut hidden = hidden.iter();
            for (i, class) in (0..).zip(&shape.class) {
                let (x, y) = (shape.rect.x + i % shape.rect.w, shape.rect.y + i / shape.rect.w);
                let colour = match class {
                    c if *c == Class::Hidden as u8 => hidden.next().copied().unwrap_or_default(),
                    c if *c == Class::Photo as u8 => photo.at(x, y),
                    _ => continue,
                };
                let off = LIGHT(x, y).into_iter().zip(colour).map(|(wall, c)| (wall - f64::from(c)).abs());
                most = if (self.near)(x, y) { most } else { off.fold(most, f64::max) };
            }
        }
        most
    }

    /// The greatest error of a share of the thing in front of a pixel of the wall, in 255ths; of the pixels that no thing lies on.
    fn off(&self, tiles: &[Vec<TexturedLayer>]) -> f64 {
        let mut shares = vec![0.0_f64; (WIDTH * HEIGHT) as usize];
        for shape in tiles.iter().flatten().map(|l| &l.shape).filter(|s| s.plane.a > 0.5) {
            for (i, (class, alpha)) in (0..).zip(shape.class.iter().zip(&shape.alpha)) {
                let (x, y) = (shape.rect.x + i % shape.rect.w, shape.rect.y + i / shape.rect.w);
                // a soft rim of the photo's own colours is no matte
                let counts = *class == Class::Hidden as u8 || *alpha == u8::MAX;
                let share = if counts { f64::from(*alpha) } else { 0.0 };
                let at = &mut shares[(y * WIDTH + x) as usize];
                *at = at.max(share);
            }
        }
        let off = |(i, share): (u32, &f64)| {
            let (x, y) = (i % WIDTH, i / WIDTH);
            if (self.near)(x, y) { 0.0 } else { (share - 255.0 * (self.share)(x, y)).abs() }
        };
        (0..).zip(&shares).map(off).fold(0.0, f64::max)
    }
}

/// `kernel` colours and mattes the layers of a geometry.
pub(super) fn cases(checked: &mut Checked, kernel: impl Fn(&Photo, &Geometry) -> Vec<Vec<TexturedLayer>>) {
    for subject in subjects() {
        let (photo, geometry) = (subject.photo(), subject.geometry());
        checked.case("matting", &format!("identity view, {}", subject.name), "mattes", "levels", 0.0, || {
            let Ok(view) = draw_reference_view(&compose(photo.clone(), &geometry, kernel(&photo, &geometry))) else { return f64::INFINITY };
            let off = |(a, b): (&[u8; 4], &[u8; 3])| (0..3).map(|c| a[c].abs_diff(b[c])).max().unwrap_or(0).max(u8::MAX - a[3]);
            view.rgba.iter().zip(&photo.rgb).map(off).max().map_or(f64::INFINITY, f64::from)
        });
        if let Some(bound) = subject.bound {
            checked.case("matting", &format!("shares, {}", subject.name), "mattes", "255ths", bound, || {
                subject.off(&kernel(&photo, &geometry))
            });
        }
    }
    for subject in subjects().iter().filter(|s| s.name == "a halo") {
        checked.case("matting", "the wall behind a halo", "mattes", "levels", 1.0, || {
            let (photo, geometry) = (subject.photo(), subject.geometry());
            subject.off_wall(&photo, &kernel(&photo, &geometry))
        });
    }
    let alike = &subjects()[0];
    checked.case("matting", "nothing changes, foreground and background alike", "mattes", "texels", 0.0, || {
        let (photo, geometry) = (alike.photo(), alike.geometry());
        let plain = Geometry { matte_band: 0, ..geometry.clone() };
        let all = |tiles: Vec<Vec<TexturedLayer>>| tiles.into_iter().flatten().flat_map(|l| l.shape.alpha).collect::<Vec<u8>>();
        let (with, without) = (all(kernel(&photo, &geometry)), all(texture(&photo, &plain, plain.masks())));
        (with.len().abs_diff(without.len()) + with.iter().zip(&without).filter(|(a, b)| a != b).count()) as f64
    });
}
