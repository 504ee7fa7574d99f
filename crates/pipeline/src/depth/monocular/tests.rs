use super::*;
use crate::networks::Tensor;

/// A network that returns the outputs that `f` gives for the width and height of its input.
fn returning(f: impl Fn(usize, usize) -> Vec<Tensor> + Send + Sync + 'static) -> Arc<dyn Network> {
    Arc::new(move |input: &Tensor| {
        let [.., h, w] = input.shape[..] else { panic!("{:?}", input.shape) };
        f(w, h)
    })
}

/// A network that returns a plane of disparity that the test chose, whatever the picture.
fn stub(f: fn(usize, usize) -> f32) -> Arc<dyn Network> {
    returning(move |w, h| vec![Tensor { shape: vec![1, 1, h, w], data: map(w, h, f).data }])
}

fn photo(width: u32, height: u32) -> Photo {
    Photo::from_fn(width, height, |x, y| [((y * width + x) % 251) as u8, (y % 253) as u8, ((y * width + x) % 17) as u8])
}

/// The embedded network's adapter with a single run.
const ONE_RUN: Adapter = Adapter { flip: false, ..super::super::ADAPTERS[0] };

fn with(f: fn(usize, usize) -> f32) -> Monocular {
    Monocular::new(&ONE_RUN, stub(f))
}

#[test]
fn only_the_share_of_a_ramp_is_added_to_a_map() {
    let ramped = |ramp: f64, f: fn(usize, usize) -> f32| {
        let adapter = Adapter { ramp, ..ONE_RUN };
        Monocular::new(&adapter, stub(f)).raw(&photo(96, 64)).unwrap()
    };
    let flat = ramped(0.0, |x, _| x as f32);
    let (w, h) = (flat.width as usize, flat.height as usize);
    for share in [0.05, 0.2, 3.0] {
        let map = ramped(share, |x, _| x as f32);
        let added: Vec<f64> = map.delta.iter().zip(&flat.delta).map(|(a, b)| f64::from(a - b)).collect();
        // in f64, by the definition: row y − mean, over the deviation of the rows
        let rows = || (0..h).map(|y| y as f64);
        let mean = rows().sum::<f64>() / h as f64;
        let of_rows = (rows().map(|y| (y - mean).powi(2)).sum::<f64>() / h as f64).sqrt();
        let columns = (0..w).map(|x| (x as f64 - (w - 1) as f64 / 2.0).powi(2)).sum::<f64>() / w as f64;
        for (i, got) in added.iter().enumerate() {
            let want = share * columns.sqrt() * ((i / w) as f64 - mean) / of_rows;
            assert!((got - want).abs() < 1e-4 * columns.sqrt(), "{share}: {got} for {want}");
        }
    }
    // without relief there is no ramp
    assert!(ramped(0.2, |_, _| 7.0).delta.iter().all(|v| (v - 7.0).abs() < 1e-12));
    let mut line = DisparityMap { width: 3, height: 1, delta: vec![1.0, 2.0, 4.0] };
    add_ramp(&mut line, 0.2);
    assert_eq!(line.delta, [1.0, 2.0, 4.0]);
    // one outlier says nothing about how much the other values vary
    let wild = |y: usize| if y == 3 { 1e9 } else { 0.0 };
    let mut map = DisparityMap { width: 1, height: 64, delta: (0..64).map(|y| y as f32 + wild(y)).collect() };
    add_ramp(&mut map, 0.2);
    assert!((map.delta[63] - 63.0).abs() < 63.0 && map.delta[63] > 63.0, "{}", map.delta[63]);
    // finite at both ends of the range of `f32`
    let mut wild = DisparityMap { width: 1, height: 2, delta: vec![f32::MAX, -f32::MAX] };
    add_ramp(&mut wild, 10.0);
    assert!(wild.delta.iter().all(|v| v.is_finite()), "{:?}", wild.delta);
}

#[test]
fn the_first_size_is_that_of_estimate_and_the_network_runs_at_every_size() {
    let (network, p) = (with(|x, y| (x + 2 * y) as f32), photo(320, 240));
    let sizes = network.sizes(320, 240);
    assert_eq!(network.estimate_at(&p, sizes[0]).unwrap().map, network.estimate(&p).unwrap());
    for size in sizes {
        assert_eq!(network.raw_at(&p, size).map(|m| (m.width, m.height)).unwrap(), size);
        let Estimate { map, network_ms: ms, .. } = network.estimate_at(&p, size).unwrap();
        assert!((map.width, map.height) == (320, 240) && ms >= 0.0 && ms.is_finite());
    }
}

#[test]
fn larger_is_nearer_for_every_kind_of_output() {
    for (kind, f) in [(Kind::Disparity, (|x, _| x as f32) as fn(usize, usize) -> f32), (Kind::Metric, |x, _| 100.0 / (x + 1) as f32)] {
        let adapter = Adapter { output: kind, ..ONE_RUN };
        let got = Monocular::new(&adapter, stub(f)).estimate(&photo(60, 40)).unwrap();
        assert!(got.delta[20 * 60] < 0.15 && got.delta[20 * 60 + 59] > 0.85, "{kind:?}");
    }
}

#[test]
fn degenerate_outputs_give_valid_maps_or_errors() {
    let p = photo(64, 48);
    let flat = with(|_, _| 7.0).estimate(&p).unwrap();
    let worst = flat.delta.iter().map(|v| (v - 0.5).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-5, "no relief: {worst}");
    let holes = with(|x, y| match x.wrapping_sub(y) {
        0 => f32::NAN,
        1 => f32::NEG_INFINITY,
        _ => x as f32,
    });
    assert!(holes.estimate(&p).unwrap().delta.iter().all(|v| v.is_finite()));
    let outlier = with(|x, y| if (x, y) == (9, 9) { 1e30 } else { x as f32 }).estimate(&p).unwrap();
    assert!(outlier.delta[63] > 0.85, "one outlier does not flatten the rest");
    let mut lone = with(|x, y| if (x, y) == (0, 0) { 1.0 } else { 0.0 }).raw(&p).unwrap();
    normalise(&mut lone.delta, 0.0);
    assert!((lone.delta[0] - 1.0).abs() < 1e-6, "the only relief is kept");
    assert!(matches!(with(|_, _| f32::NAN).estimate(&p), Err(DepthError::Onnx(OnnxError::Run { .. }))));
    let metric = Adapter { output: Kind::Metric, ..super::super::ADAPTERS[0] };
    let got = Monocular::new(&metric, stub(|x, _| x as f32 - 5.0)).estimate(&p).unwrap();
    assert!(got.delta.iter().all(|v| (0.0..=1.0).contains(v)), "distances of 0 and below");
}

fn several(name: &str, outputs: &[&str], f: impl Fn(usize, usize) -> Vec<Tensor> + Send + Sync + 'static) -> Monocular {
    let adapter = super::super::adapter(name).unwrap();
    let info = |name: &str, shape: &[i64]| crate::networks::TensorInfo { name: name.into(), shape: shape.to_vec() };
    let outputs: Vec<_> = outputs.iter().map(|o| info(o, &[])).collect();
    let (io, ..) = OnnxIo::of(adapter, &[info("image", &[1, 3, -1, -1])], &outputs).unwrap();
    Monocular { io, ..Monocular::new(adapter, returning(f)) }
}

fn map(w: usize, h: usize, f: impl Fn(usize, usize) -> f32) -> Tensor {
    Tensor { shape: vec![1, h, w], data: (0..w * h).map(|i| f(i % w, i / w)).collect() }
}

/// Points of a plane that recedes to the right from 1 to 3, moved nearer by 0.5; distances are these times 2.
fn plane(w: usize, h: usize, focal: f64) -> Vec<Tensor> {
    let diagonal = (w as f64).hypot(h as f64);
    let mut points = map(3 * w, h, |k, y| {
        let z = 1.0 + 2.0 * (k / 3) as f64 / w as f64;
        let [u, v] = [(2 * (k / 3) + 1) as f64 - w as f64, (2 * y + 1) as f64 - h as f64].map(|p| p * z / diagonal / focal);
        [u, v, z - 0.5][k % 3] as f32
    });
    points.shape = vec![1, h, w, 3];
    vec![points, map(w, h, |_, y| if y < h / 4 { 0.5 } else { 0.9 }), Tensor { shape: vec![1], data: vec![2.0] }]
}

#[test]
fn points_become_disparities_and_sky_is_infinitely_far() {
    let names = ["points", "mask", "scale"];
    for f in [(|w, h| plane(w, h, 0.7)) as fn(usize, usize) -> Vec<Tensor>, |w, h| plane(w, h, 3.0)] {
        let got = several("moge-2", &names, f).raw(&photo(300, 200)).unwrap();
        let (w, h) = (got.width as usize, got.height as usize);
        assert_eq!((w, h), (52 * 14, 35 * 14));
        for (k, delta) in got.delta.iter().enumerate() {
            let want = if k / w < h / 4 { 0.0 } else { 0.5 / (1.0 + 2.0 * (k % w) as f64 / w as f64) };
            assert!((f64::from(*delta) - want).abs() < 1e-4, "{delta} for {want}");
        }
    }
    let got = several("moge-2", &names, |w, h| plane(w, h, 1.0)).estimate(&photo(300, 200)).unwrap();
    assert!(got.delta[..300 * 40].iter().all(|d| *d < 0.01) && got.delta[300 * 150] > 0.95);
}

#[test]
fn a_photo_of_only_sky_is_flat_and_an_output_without_numbers_is_an_error() {
    let changed = |change: fn(&mut [Tensor])| {
        several("moge-2", &["points", "mask"], move |w, h| {
            let mut outputs = plane(w, h, 1.0);
            change(&mut outputs);
            outputs
        })
    };
    let all_sky = changed(|outputs| outputs[1].data.fill(0.0));
    let got = all_sky.estimate(&photo(40, 30)).unwrap();
    assert!(got.delta.iter().all(|v| (v - FLAT).abs() < 1e-5));
    let sky = several("depth-anything-3", &["depth", "sky"], |w, h| vec![map(w, h, |x, _| x as f32 + 1.0), map(w, h, |_, _| 1.0)]);
    assert!(sky.estimate(&photo(40, 30)).unwrap().delta.iter().all(|v| (v - FLAT).abs() < 1e-5));
    let nothing = changed(|outputs| outputs.iter_mut().for_each(|t| t.data.fill(f32::NAN)));
    assert!(nothing.estimate(&photo(40, 30)).unwrap_err().to_string().contains("no finite value"));
    let behind = several("depth-anything-3", &["depth"], |w, h| vec![map(w, h, |_, _| -1.0)]);
    assert!(behind.estimate(&photo(40, 30)).unwrap_err().to_string().contains("no positive distance"));
    let holes = changed(|outputs| {
        let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
        outputs[0].data.iter_mut().step_by(97).enumerate().for_each(|(i, v)| *v = wild[i % 3]);
        outputs[1].data.iter_mut().step_by(89).for_each(|v| *v = f32::NAN);
    });
    let got = holes.estimate(&photo(40, 30)).unwrap();
    assert!(got.delta.iter().all(|v| (0.0..=1.0).contains(v)) && got.delta[40 * 20] > got.delta[40 * 20 + 38]);
    let wild = changed(|outputs| {
        outputs[0].data.iter_mut().step_by(97).enumerate().for_each(|(i, v)| *v = [-1e30, 1e30, -1.0, 0.0][i % 4]);
    });
    assert!(wild.estimate(&photo(40, 30)).unwrap().delta.iter().all(|v| (0.0..=1.0).contains(v)));
    let small = several("moge-2", &["points", "mask"], |w, h| vec![plane(w, h, 1.0).swap_remove(0), map(0, 0, |_, _| 0.0)]);
    assert!(small.estimate(&photo(40, 30)).unwrap_err().to_string().contains("as its mask"));
}

#[test]
fn every_shape_of_photo_runs_through_every_network() {
    for (w, h) in [(1, 1), (2, 3), (1, 16_384), (16_384, 1), (63, 65), (65, 65), (1008, 686)] {
        let p = photo(w, h);
        let first = with(|x, y| (x + 2 * y) as f32).estimate(&p).unwrap();
        let moge = several("moge-2", &["points", "mask", "scale"], |w, h| plane(w, h, 1.0)).estimate(&p).unwrap();
        let three = several("depth-anything-3", &["depth"], |w, h| vec![map(w, h, |x, y| (x + y + 1) as f32)]).estimate(&p).unwrap();
        for got in [first, moge, three] {
            assert_eq!((got.width, got.height, got.delta.len()), (w, h, (w * h) as usize));
            assert!(got.delta.iter().all(|v| (0.0..=1.0).contains(v)), "{w}×{h}");
        }
    }
}

#[test]
fn networks_of_several_inputs_outputs_and_files_load_and_run() {
    let Some(()) = tmpi_testing::Need::Onnx.or_skip(crate::networks::available()) else { return };
    let load = |name: &str, model, beside: &[ExternalData]| {
        Monocular::load(super::super::adapter(name).unwrap(), model, beside, &Config::default())
    };
    // the left half is black and outside of the mask; in the right half blue is the distance, up to the shift and with 1813 tokens as the
    // scale
    let half = Photo { width: 40, height: 30, rgb: (0..1200).map(|i| if i % 40 < 20 { [0; 3] } else { [200, 200, 255] }).collect() };
    let got = load("moge-2", include_bytes!("../../../../../tests/onnx/points.onnx"), &[]).unwrap().raw(&half).unwrap();
    assert_eq!((got.width, got.height), (49 * 14, 37 * 14));
    let (left, right) = (got.delta[686 * 100], got.delta[686 * 100 + 600]);
    assert!(left.abs() < 1e-9 && right > 0.0 && right < 1.0, "{left} {right}");
    let views = include_bytes!("../../../../../tests/onnx/views.onnx");
    let weights = || ("views.onnx_data".to_owned(), Arc::from(include_bytes!("../../../../../tests/onnx/views.onnx_data").as_slice()));
    let grey = Photo { width: 40, height: 30, rgb: vec![[124, 116, 104]; 1200] };
    let got = load("depth-anything-3", views, &[weights()]).unwrap().raw(&grey).unwrap();
    assert_eq!((got.width, got.height), (504, 378));
    // ImageNet's mean becomes 0, and distances are 3
    assert!(got.delta.iter().all(|d| (d - 1.0 / 3.0).abs() < 1e-2), "{}", got.delta[0]);
    assert!(matches!(load("depth-anything-3", views, &[]), Err(OnnxError::Model { .. })), "weights are missing");
    let stem = include_bytes!("../../../../../tests/onnx/stem.onnx");
    let got = load("dpt-large", stem, &[]).unwrap().raw(&grey).unwrap();
    assert_eq!((got.width, got.height), (64, 32), "the file's dimensions");
    let wrong = load("moge-2", stem, &[]).err().unwrap().to_string();
    assert!(wrong.contains("returns depth, but none is called points"), "{wrong}");
}

#[test]
fn flipping_averages_both_runs() {
    // a network that ignores the picture returns the same ramp for the mirrored photo: the mean has no horizontal slope
    let adapter = Adapter { flip: true, ramp: 0.0, ..ONE_RUN };
    let got = Monocular::new(&adapter, stub(|x, y| (x + 10 * y) as f32)).raw(&photo(90, 60)).unwrap();
    let (w, h) = (got.width as usize, got.height as usize);
    for (y, row) in got.delta.chunks(w).enumerate() {
        let want = (w - 1) as f32 / 2.0 + (10 * y) as f32;
        assert!(row.iter().all(|v| (v - want).abs() < 0.1), "row {y} of {h}: {} to {}, not {want}", row[0], row[w - 1]);
    }
}

#[test]
fn a_real_file_is_loaded_and_run() {
    let Some(()) = tmpi_testing::Need::Onnx.or_skip(crate::networks::available()) else { return };
    let mean = include_bytes!("../../../../../tests/onnx/mean.onnx");
    let plain = Adapter { mean: [0.0; 3], deviation: [1.0; 3], ..ONE_RUN };
    let got = Monocular::load(&plain, mean, &[], &Config::default()).unwrap();
    let grey = Photo { width: 48, height: 32, rgb: (0..48 * 32).map(|i| [(i % 48 * 5) as u8; 3]).collect() };
    let raw = got.raw(&grey).unwrap();
    assert_eq!((raw.width, raw.height), (256, 192));
    assert!((raw.delta[96 * 256 + 128] - 0.46).abs() < 0.03, "{}", raw.delta[96 * 256 + 128]);
    let two = include_bytes!("../../../../../tests/onnx/sum_difference.onnx");
    assert!(matches!(Monocular::load(&plain, two, &[], &Config::default()), Err(OnnxError::Model { .. })));
}
