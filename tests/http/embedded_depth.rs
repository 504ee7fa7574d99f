//! Photos with depth: in their file, in the three formats of phones, or as a map in the form.

use image::{DynamicImage, GrayImage, ImageFormat, Luma};
use tmpi_core::{Class, Scene, TileFrame};
use tmpi_pipeline::depth::{DepthKind, from_map};
use tmpi_testing::pictures::encoded;

use crate::prelude::*;

/// Files as phones write them: 64 × 48 pixels, maps of half that size with one step in the middle.
const PHONES: [(&str, &[u8], [f64; 2]); 3] = [
    // values .2 and .8 of distances 1 to 5, linear in 1/z or in z
    ("gdepth", include_bytes!("../../fuzz/seeds/embedded_depth/gdepth.jpg"), [0.84, 0.36]),
    ("dynamic-depth", include_bytes!("../../fuzz/seeds/embedded_depth/dynamic-depth.jpg"), [1.0 / 1.8, 1.0 / 4.2]),
    // disparity .5 to 2, over 2
    ("multi-picture", include_bytes!("../../fuzz/seeds/embedded_depth/multi-picture.jpg"), [0.4, 0.85]),
];
/// The error of a value in a JPEG, and some margin.
const CLOSE: f64 = 0.012;

/// A finished photo.
struct Made {
    report: Value,
    /// The served disparity map in row-major order, and its width.
    map: (Vec<f32>, usize),
    scene: Scene,
}

fn made(server: &Running, id: &str) -> Made {
    let state = server.wait(id, "done");
    let part = |name: &str| get(server.addr, &format!("/v1/photos/{id}/{name}"));
    let (w, h) = (state["width"].as_u64().unwrap() as u32, state["height"].as_u64().unwrap() as u32);
    let (map, size) = from_map(&part("depth").body, DepthKind::Disparity, &tmpi_pipeline::photo::Limits::default(), w, h).unwrap();
    assert_eq!(size, (w, h), "the map has the scene's size");
    Made { report: part("report").json(), map: (map.delta, w as usize), scene: tmpi_core::container::decode(&part("atlas").body).unwrap() }
}

impl Made {
    /// Disparity of the served map at fractions of width and height.
    fn served(&self, x: f64, y: f64) -> f64 {
        let (delta, width) = &self.map;
        let height = delta.len() / width;
        f64::from(delta[(y * height as f64) as usize * width + (x * *width as f64) as usize])
    }

    /// Disparity of the atlas there: of the nearest plane with a pixel of the photo.
    fn shown(&self, x: f64, y: f64) -> f64 {
        let (grid, texels) = (&self.scene.grid, &self.scene.texels);
        let (x, y) = ((x * f64::from(grid.width)) as u32, (y * f64::from(grid.height)) as u32);
        let of = |layer: &tmpi_core::Layer| {
            let r = layer.rect;
            let inside = (r.x..r.x + r.w).contains(&x) && (r.y..r.y + r.h).contains(&y);
            let texel = inside.then(|| layer.first_texel + ((y - r.y) * r.w + x - r.x) as usize)?;
            (texels.class[texel] == Class::Photo as u8).then(|| f64::from(TileFrame::of(grid, layer.tile).disparity(&layer.plane, x, y)))
        };
        self.scene.layers.iter().filter_map(of).fold(f64::NAN, f64::max)
    }

    /// Compares map and atlas with the two values of a map with a step in the middle.
    #[track_caller]
    fn is_of(&self, [left, right]: [f64; 2], name: &str) {
        for (x, want) in [(0.1, left), (0.4, left), (0.6, right), (0.9, right)] {
            for y in [0.2, 0.5, 0.8] {
                let served = self.served(x, y);
                assert!((served - want).abs() < CLOSE, "{name}: the map has {served} at {x}, {y} in place of {want}");
            }
        }
        // planes of a small photo may be off as long as no pixel moves by much, most of all at the step
        for (x, want) in [(0.1, left), (0.9, right)] {
            for y in [0.2, 0.5, 0.8] {
                let shown = self.shown(x, y);
                assert!((shown - want).abs() < 0.25 * (left - right).abs(), "{name}: the atlas has {shown} at {x}, {y} in place of {want}");
            }
        }
        let (delta, width) = &self.map;
        let step = (0..delta.len()).map(|i| if i % width < width / 2 { left } else { right });
        let with = correlation(delta.iter().map(|&d| f64::from(d)), step);
        assert!(with > 0.98, "{name}: correlation of {with}");
    }
}

/// Pearson's correlation.
fn correlation(a: impl Iterator<Item = f64> + Clone, b: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = a.clone().count() as f64;
    let (ma, mb) = (a.clone().sum::<f64>() / count, b.clone().sum::<f64>() / count);
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.zip(b) {
        let (x, y) = (x - ma, y - mb);
        (ab, aa, bb) = (ab + x * y, aa + x * x, bb + y * y);
    }
    ab / (aa * bb).sqrt()
}

#[test]
fn depth_in_the_file_is_used_unless_it_is_off() {
    let server = Running::open();
    for (name, file, ends) in PHONES {
        let with = made(&server, &server.upload(file));
        let input = &with.report["input"];
        assert_eq!((&with.report["depth_model"], &input["depth"]["source"]), (&"embedded".into(), &name.into()));
        assert_eq!((&input["depth"]["width"], &input["depth"]["height"]), (&32.into(), &24.into()), "{name}");
        assert_eq!((&input["depth"]["stretched"], &input["depth_problem"]), (&false.into(), &Value::Null), "{name}");
        with.is_of(ends, name);

        let off = request(server.addr, "POST", "/v1/photos?photo-depth=off", &[], file).json();
        assert_eq!(off["options"]["photo-depth"], "off");
        let without = made(&server, off["id"].as_str().unwrap());
        assert_eq!((&without.report["depth_model"], &without.report["input"]["depth"]), (&"ramp".into(), &Value::Null), "{name}");
        // the network's map is nearer towards the bottom and has no step
        assert!(without.served(0.25, 0.9) > without.served(0.25, 0.1) + 0.5, "{name}");
        assert!((without.served(0.1, 0.5) - without.served(0.9, 0.5)).abs() < 0.1, "{name}");
    }
    // without ONNX Runtime the photo may fail
    let on = request(server.addr, "POST", "/v1/photos?photo-depth=on", &[], &jpeg(1)).json();
    server.wait(on["id"].as_str().unwrap(), "failed");
}

#[test]
fn a_map_in_the_form_is_used_in_every_format() {
    let server = Running::open();
    let grey = |w, h| DynamicImage::from(GrayImage::from_fn(w, h, |x, _| Luma([if x < w / 2 { 64 } else { 191 }])));
    let maps = [
        ("16 bits", depth_map(), false),
        ("8 bits", encoded(grey(80, 60), ImageFormat::Png), false),
        ("in colour", encoded(grey(80, 60).into_rgb8(), ImageFormat::Png), false),
        ("a JPEG", encoded(grey(80, 60), ImageFormat::Jpeg), false),
        ("a JPEG in colour", encoded(grey(80, 60).into_rgb8(), ImageFormat::Jpeg), false),
        ("smaller", encoded(grey(40, 30), ImageFormat::Png), false),
        ("of another shape", encoded(grey(60, 60), ImageFormat::Png), true),
    ];
    for (name, map, stretched) in maps {
        let state = post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", &map)]).json();
        assert_eq!(state["depth_bytes"], map.len(), "{name}");
        let made = made(&server, state["id"].as_str().unwrap());
        let depth = &made.report["input"]["depth"];
        assert_eq!([&made.report["depth_model"], &depth["source"]], ["given"; 2], "{name}");
        assert_eq!(depth["stretched"], stretched, "{name}");
        made.is_of([0.25, 0.75], name);
    }
    // the map in the form takes precedence over the file's own depth
    let (_, phone, _) = PHONES[0];
    let state = post_form(server.addr, &[], &[("photo", phone), ("depth", &depth_map())]).json();
    let both = made(&server, state["id"].as_str().unwrap());
    assert_eq!(both.report["input"]["depth"]["source"], "given");
    both.is_of([0.25, 0.75], "beside a photo with depth");
}
