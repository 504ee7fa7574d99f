//! Tests the command line of the built program: exit codes, output streams, JSON and files.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::path::Path;

use image::{Luma, Rgb, RgbImage};
use serde_json::Value;
use tmpi_testing::Need;
use tmpi_testing::program::{Folder, box_before_a_wall};

fn folder() -> Folder {
    Folder::of(env!("CARGO_BIN_EXE_tmpi-lab"))
}

/// Whether networks can run.
fn has_networks() -> bool {
    Need::Onnx.or_skip(tmpi_pipeline::networks::available().map_err(|e| e.to_string())).is_some()
}

#[test]
fn help_succeeds_and_wrong_arguments_are_usage_errors() {
    let f = folder();
    let help = f.run(&["--help"]).succeeds();
    assert!(help.err.is_empty(), "{}", help.err);
    for name in ["check", "bench", "eval", "synth", "compare", "live-bench"] {
        assert!(help.out.contains(&format!("\n  {name} ")), "{name}: {}", help.out);
        f.run(&[name, "--help"]).succeeds();
    }
    f.run(&["make"]).fails(2, &["make"]);
    f.run(&["live-bench", "--size", "9999x9999"]).fails(2, &["--size"]);
    f.run(&["live-bench", "--size", "64x48,96x64", "--learn", "prior"]).fails(2, &["--learn"]);
    f.run(&["bench", "--only", "best"]).fails(2, &["--only", "planes"]);
    f.run(&["bench", "--repeats", "0"]).fails(2, &["--repeats"]);
}

#[test]
fn compare_reports_picture_metrics() {
    let f = folder().with_box();
    let same = f.run(&["compare", "box.png", "box.png", "--json"]).succeeds().json();
    assert_eq!((same["flip"].as_f64(), same["share_off"].as_f64(), same["max_abs"].as_u64()), (Some(0.0), Some(0.0), Some(0)));
    let jpeg = f.run(&["compare", "box.png", "box.jpg", "--json"]).succeeds().json();
    let between = |name: &str, least: f64, most: f64| assert!((least..most).contains(&jpeg[name].as_f64().unwrap()), "{name}: {jpeg}");
    between("psnr", 25.0, 60.0);
    between("flip", 1e-4, 0.3);
    between("ssim", 0.5, 1.0);
    // grey pictures work too
    image::GrayImage::from_fn(150, 100, |x, _| Luma([x as u8])).save(f.path("grey.png")).unwrap();
    f.run(&["compare", "box.png", "grey.png"]).succeeds();
    RgbImage::from_pixel(3, 2, Rgb([1, 2, 3])).save(f.path("small.png")).unwrap();
    f.run(&["compare", "box.png", "small.png"]).fails(1, &["differ in size", "150×100", "3×2"]);
    f.run(&["compare", "box.png", "nosuch.png"]).fails(1, &["nosuch.png"]);
}

#[test]
fn check_measures_view_box_corners_on_photos() {
    let f = folder();
    if !has_networks() {
        return;
    }
    std::fs::create_dir(f.path("photos")).unwrap();
    // the bounds, in percent of pixels, apply to photos of typical size
    let large = image::imageops::resize(&box_before_a_wall(), 600, 400, image::imageops::FilterType::Nearest);
    large.save(f.path("photos/box.png")).unwrap();
    f.write("photos/notes.txt", b"no photo");
    let checked = f.run(&["check", "--photos", "photos", "--json"]).succeeds().json();
    let cases = checked["cases"].as_array().unwrap();
    assert_eq!((cases.len(), cases[0]["name"].as_str()), (4, Some("half-way to them, box.png, holes")));
}

/// Whether a page is complete and its plots have only finite numbers.
fn is_whole(page: &str, plots: usize) -> bool {
    page.matches("<svg").count() == plots
        && page.trim_end().ends_with("</html>")
        && !["NaN", "inf<", "inf\""].iter().any(|n| page.contains(n))
}

#[test]
fn bench_measures_and_draws_each_setting() {
    let f = folder();
    f.run(&["bench", "--quick", "--repeats", "2", "--only", "levels", "-o", "measured"]).succeeds();
    let read = |name: &str| std::fs::read_to_string(f.path("measured").join(name)).unwrap();
    let results: Value = serde_json::from_str(&read("results.json")).unwrap();
    let [experiment] = results["experiments"].as_array().unwrap().as_slice() else { panic!("{results}") };
    let points = experiment["curves"][0]["points"].as_array().unwrap();
    let of = |name: &str| points.iter().map(|point| point[name].clone()).collect::<Vec<_>>();
    assert_eq!(experiment["id"], "levels");
    assert_eq!(of("setting"), ["level 0", "level 1", "level 2", "level 3"]);
    assert_eq!(of("default"), [true, false, false, false]);
    // a figure that is not finite would be null
    let figures = points.iter().flat_map(|point| point["figures"].as_array().unwrap());
    assert!(points.iter().all(|point| point["figures"].as_array().is_some_and(|all| all.len() > 10)));
    assert!(figures.map(|figure| &figure[1]).chain(&of("x")).chain(&of("y")).all(Value::is_number), "{experiment}");
    // times are the medians of two runs, which are not equal
    assert_eq!(results["repeats"], 2);
    for point in points {
        let named = |list: &str| {
            let list = point[list].as_array().unwrap();
            list.iter().find(|entry| entry[0] == "processing, ms").unwrap_or_else(|| panic!("{point}"))[1].clone()
        };
        let (ms, range) = (named("figures").as_f64().unwrap(), named("ranges"));
        assert!(range[0].as_f64().unwrap() < ms && ms < range[1].as_f64().unwrap(), "{point}");
    }
    // smaller levels have fewer bytes, and views that are less like the true ones
    let falls = |axis: &str| of(axis).windows(2).all(|pair| pair[0].as_f64() > pair[1].as_f64());
    assert!(falls("x") && falls("y"), "{experiment}");
    let page = read("index.html");
    assert!(page.contains("id=\"levels\"") && is_whole(&page, 1), "the page is broken");
    assert!(points.iter().all(|point| page.contains(&format!("<td>{}", point["setting"].as_str().unwrap()))), "all are in its table");
    assert_eq!(page.matches("<tr class=\"default\">").count(), 1);
}

#[test]
fn live_bench_measures_and_draws_each_point() {
    let f = folder();
    let short = ["live-bench", "--only", "measured", "--frames", "4", "--views", "2", "--size", "96x64"];
    let run = f.run(&[&short[..], &["--budget-ms", "0,50", "--json", "--page", "room.html"]].concat()).succeeds().json();
    let points = run["points"].as_array().unwrap();
    assert_eq!(points.iter().map(|point| point["budget_ms"].as_f64()).collect::<Vec<_>>(), [Some(0.0), Some(50.0)]);
    for point in points {
        let figures = point["figures"].as_object().unwrap();
        assert!(figures.len() > 20 && figures.values().all(Value::is_number), "{point}");
        // far from the truth if the stream or the view were broken
        assert!(figures["side view, dB"].as_f64().unwrap() > 15.0 && figures["video, bytes"].as_f64().unwrap() > 0.0, "{point}");
    }
    let page = std::fs::read_to_string(f.path("room.html")).unwrap();
    assert!(page.contains("--size 96x64") && is_whole(&page, 2), "the page is broken");
}

#[test]
fn eval_scores_methods_on_rendered_scenes() {
    let f = folder();
    f.run(&["synth", "-o", "scenes", "--count", "1", "--size", "160x96", "--views", "2", "--baseline", "0.03"]).succeeds();
    let results = f.run(&["eval", "scenes", "--only", "mesh,ours", "--json"]).succeeds().json();
    assert_eq!((results["views"].as_u64(), results["blank"].as_u64(), results["depth_score"].is_null()), (Some(2), Some(0), true));
    for (row, way) in results["rows"].as_array().unwrap().iter().zip(["mesh", "ours"]) {
        assert_eq!(row["way"].as_str(), Some(way));
        // 34.7 dB and .973, 34.8 dB and .967
        assert!(row["score"]["psnr"].as_f64().unwrap() > 34.0 && row["score"]["ssim"].as_f64().unwrap() > 0.96, "{row}");
        assert!(row["bytes"].as_f64().unwrap() > 0.0 && row["make_ms"].as_f64().unwrap() > 0.0, "{row}");
    }
    f.run(&["eval", "scenes", "--only", "best"]).fails(2, &["--only", "tmpi-lloyd"]);
    f.run(&["eval", "scenes/00000000", "--only", "mesh"]).succeeds();
    std::fs::create_dir(f.path("empty")).unwrap();
    f.run(&["eval", "empty"]).fails(1, &["stereo pair"]);
    f.run(&["eval", "nowhere"]).fails(1, &["nowhere"]);
}

#[test]
fn lpips_uses_a_network_with_two_inputs() {
    let f = folder();
    if !has_networks() {
        return;
    }
    f.run(&["synth", "-o", "scenes", "--count", "1", "--size", "160x96", "--views", "2", "--baseline", "0.03"]).succeeds();
    let network = |name: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../../tests/onnx/{name}.onnx"));
        path.to_str().unwrap().to_owned()
    };
    let results = f.run(&["eval", "scenes", "--only", "ours", "--lpips", &network("distance"), "--json"]).succeeds().json();
    let score = &results["rows"][0]["score"];
    // LPIPS pictures have values from −1 to 1, those of L1 from 0 to 1; pixels that are not scored count as equal
    let (lpips, l1) = (score["lpips"].as_f64().unwrap(), score["l1"].as_f64().unwrap());
    assert!(lpips > l1 && lpips <= 2.0 * l1 + 1e-6, "{lpips} {l1}");
    f.run(&["eval", "scenes", "--lpips", &network("mean")]).fails(1, &["two"]);
}
