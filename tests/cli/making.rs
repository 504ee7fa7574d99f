//! `tmpi make` and `tmpi depth`.

use std::path::Path;

use image::DynamicImage;
use serde_json::Value;
use tmpi_testing::jpeg::{segment, with_segments};

use crate::fixture::{Folder, Run, has};

#[test]
fn make_writes_a_container_and_a_report() {
    let f = Folder::new();
    let args = ["make", "box.png", "--depth", "depth.png", "-o", "new/box.tmpi", "--json", "--report", "report.json"];
    let run = f.run(&args).succeeds();
    assert!(run.err.contains("placing planes"), "progress is on standard error: {}", run.err);
    assert_eq!(run.out.lines().count(), 1);
    let line = run.json();
    has(&line, &["photo", "output", "bytes", "report.tiles"]);
    assert_eq!(line["bytes"].as_u64().unwrap(), std::fs::metadata(f.path("new/box.tmpi")).unwrap().len());
    let report: Value = serde_json::from_slice(&std::fs::read(f.path("report.json")).unwrap()).unwrap();
    has(&report, &["input.width", "input.height", "input.bytes", "total_ms", "peak_rss_bytes", "tiles", "planes", "planes_per_tile"]);
    has(&report, &["left_out.planes", "left_out.tiles_not_refined", "left_out.texels", "left_out.bytes"]);
    has(&report, &["bytes.total", "bytes.index", "bytes.photo", "bytes.alpha", "bytes.hidden"]);
    has(&report, &["error.depth_mae", "error.depth_mse", "error.depth_q25", "error.identity_psnr", "error.codec_psnr"]);
    has(&report, &["error.planes.mean_px", "error.planes.bound_px", "error.planes.missed_tiles", "error.identity_tiles"]);
    assert_eq!(report.pointer("/error/prune"), Some(&Value::Null), "present, and null because it is not measured");
    for stage in report["stages"].as_array().unwrap() {
        has(stage, &["name", "ms", "cpu_ms"]);
    }
    assert_eq!((report["input"]["width"].as_u64(), report["input"]["height"].as_u64()), (Some(150), Some(100)));
    let quiet = f.run(&["make", "box.jpg", "--depth", "depth.png", "-o", "b.tmpi", "--quiet"]).succeeds();
    assert_eq!((quiet.out.as_str(), quiet.err.as_str()), ("", ""));
    let run = f.run(&["make", "box.jpg", "--depth", "depth.png", "-o", "c.tmpi"]).succeeds();
    assert!(run.out.starts_with("c.tmpi: 150×100") && run.out.lines().count() == 1, "{}", run.out);
    assert!(!run.err.contains("shape"), "{}", run.err);
    // half of the depth map has another aspect ratio than the photo
    image::open(f.path("depth.png")).unwrap().crop_imm(0, 0, 75, 100).save(f.path("half.png")).unwrap();
    let stretched = f.run(&["make", "box.jpg", "--depth", "half.png", "-o", "d.tmpi"]).succeeds();
    assert!(stretched.err.contains("box.jpg: its depth map (75×100) has another shape than the photo"), "{}", stretched.err);
    assert!(!f.names().iter().any(|n| Path::new(n).extension().is_some_and(|e| e == "part")));
}

#[test]
fn make_uses_the_depth_map_beside_a_photo() {
    let f = Folder::new();
    std::fs::create_dir_all(f.path("photos/more")).unwrap();
    for (from, to) in [("box.jpg", "a.jpg"), ("depth.png", "a_depth.png"), ("box.png", "more/b.png"), ("depth.png", "more/B-Disparity.png")]
    {
        std::fs::copy(f.path(from), f.path(&format!("photos/{to}"))).unwrap();
    }
    let run = f.run(&["make", "photos", "-o", "made", "--report", "all.json"]).succeeds();
    let line = |of: &str| run.out.lines().find(|line| line.contains(of)).unwrap_or_default().to_owned();
    assert_eq!(run.out.lines().count(), 2, "a depth map is not a photo: {}", run.out);
    assert!(line("a.tmpi").ends_with(", depth from photos/a_depth.png"), "{}", run.out);
    assert!(line("b.tmpi").ends_with(", depth from photos/more/B-Disparity.png"), "{}", run.out);
    let reports: Value = serde_json::from_slice(&std::fs::read(f.path("all.json")).unwrap()).unwrap();
    for made in reports.as_array().unwrap() {
        assert_eq!((&made["report"]["depth_model"], &made["report"]["input"]["depth"]["width"]), (&"given".into(), &150.into()));
    }
    // `--depth` with the same map gives the same bytes
    f.run(&["make", "box.jpg", "--depth", "depth.png", "-o", "one.tmpi", "-q"]).succeeds();
    assert_eq!(std::fs::read(f.path("made/a.tmpi")).unwrap(), std::fs::read(f.path("one.tmpi")).unwrap());
    // `--depth` overrides the map beside the photo
    std::fs::remove_dir_all(f.path("photos/more")).unwrap();
    image::open(f.path("depth.png")).unwrap().crop_imm(0, 0, 75, 100).save(f.path("half.png")).unwrap();
    let named = f.run(&["make", "photos", "--depth", "half.png", "-o", "other", "--json"]).succeeds().json();
    assert_eq!((&named["report"]["input"]["depth"]["width"], &named["depth"]), (&75.into(), &Value::Null));
    // an invalid depth map fails only its own photo
    f.write("photos/a_depth.png", b"no picture");
    f.run(&["make", "photos", "-o", "third"]).fails(1, &["a.jpg", "depth map"]);
}

#[test]
fn options_of_make_take_effect() {
    let f = Folder::new();
    let make = |name: &str, extra: &[&str]| {
        f.run(&[&["make", "box.png", "--depth", "depth.png", "-q", "-o", name], extra].concat()).succeeds();
        f.run(&["info", name, "--json"]).succeeds().json()
    };
    assert_eq!(make("a.tmpi", &["--tile", "full"])["tiles"], 1);
    assert_eq!(make("b.tmpi", &["--max-size", "75"])["height"], 50);
    assert!((make("c.tmpi", &["--fov-x", "60"])["fov_x"].as_f64().unwrap() - 60.0).abs() < 1e-6);
    assert!((make("d.tmpi", &["--view-box", "0.1,0,0.05"])["view_box"]["x"].as_f64().unwrap() - 0.1).abs() < 1e-9);
    let one = make("e.tmpi", &["--planes", "1", "--plane-method", "lloyd"]);
    assert!(one["planes_per_tile"].as_f64().unwrap() < 2.01, "one plane, and at most a background");
}

#[test]
fn strokes_correct_the_depth() {
    let f = Folder::new();
    f.write("strokes.json", br#"{"version": 1, "strokes": [{"points": [[0.46, 0.5]], "radius": 0.12, "to": 0.1}]}"#);
    f.write("wrong.json", br#"{"strokes": [{"points": [[0.46, 1.5]], "radius": 0.12, "to": 0.1}]}"#);
    let make =
        |extra: &[&str]| f.run(&[&["make", "box.png", "--depth", "depth.png", "-q", "--json", "--force", "-o", "x.tmpi"], extra].concat());
    let report = |run: Run| run.succeeds().json()["report"].clone();
    let (before, after) = (report(make(&[])), report(make(&["--strokes", "strokes.json"])));
    assert_eq!((&before["input"]["strokes"], &after["input"]["strokes"]), (&0.into(), &1.into()));
    let steps = |report: &Value| report["stages"].as_array().unwrap().iter().filter(|s| s["name"] == "strokes").count();
    assert_eq!((steps(&before), steps(&after)), (0, 1));
    // the box is now almost as far as the wall, so it hides little
    let hidden = |report: &Value| report["bytes"]["hidden"].as_u64().unwrap();
    assert!(hidden(&after) <= hidden(&before) && after["planes"] != before["planes"], "{after}");
    make(&["--strokes", "wrong.json"]).fails(2, &["--strokes", "strokes[0].points[0]"]);
    make(&["--strokes", "nowhere.json"]).fails(2, &["--strokes"]);
    f.write("other.png", &std::fs::read(f.path("box.png")).unwrap());
    f.run(&["make", "box.png", "other.png", "-o", "out/", "--strokes", "strokes.json"]).fails(2, &["--strokes", "one photo"]);
}

#[test]
fn one_failed_photo_does_not_stop_the_rest() {
    let f = Folder::new();
    f.write("other.png", &std::fs::read(f.path("box.png")).unwrap());
    f.write("bad.jpg", b"\xFF\xD8\xFF\xE0");
    let run = f.run(&["make", "bad.jpg", "-o", "out/", "-q"]);
    run.fails(1, &["bad.jpg"]);
    if !f.has_depth() {
        return;
    }
    let run = f.run(&["make", "other.png", "bad.jpg", "box.jpg", "-o", "out", "--json", "-q", "--report", "all.json"]);
    assert_eq!(run.code, 1);
    assert_eq!(run.out.lines().count(), 2);
    assert!(run.err.contains("bad.jpg") && run.err.contains("1 of 3"));
    assert!(f.path("out/other.tmpi").is_file() && f.path("out/box.tmpi").is_file());
    let all: Value = serde_json::from_slice(&std::fs::read(f.path("all.json")).unwrap()).unwrap();
    assert_eq!(all.as_array().unwrap().len(), 2);
    has(&all[0], &["photo", "output", "report.tiles"]);
}

#[cfg(target_os = "linux")]
#[test]
fn a_photo_of_a_folder_that_cannot_be_read_is_named_and_the_others_are_made() {
    let f = Folder::new();
    std::fs::create_dir(f.path("in")).unwrap();
    for (from, name) in [("box.png", "a.png"), ("depth.png", "a_depth.png"), ("box.png", "c.png"), ("depth.png", "c_depth.png")] {
        std::fs::copy(f.path(from), f.path("in").join(name)).unwrap();
    }
    // a file whose first byte cannot be read, by root either
    std::os::unix::fs::symlink("/proc/self/mem", f.path("in/b.jpg")).unwrap();
    f.run(&["make", "in", "-o", "out", "-q"]).fails(1, &["in/b.jpg", "1 of 3"]);
    let made = ["a", "b", "c"].map(|name| f.path(&format!("out/{name}.tmpi")).is_file());
    assert_eq!(made, [true, false, true]);
}

#[test]
fn existing_outputs_are_not_overwritten_without_force() {
    let f = Folder::new();
    f.container();
    let first = std::fs::read(f.path("box.tmpi")).unwrap();
    let make = |extra: &[&str]| f.run(&[&["make", "box.jpg", "--depth", "depth.png", "-o", "box.tmpi"], extra].concat());
    make(&[]).fails(1, &["box.tmpi is there already", "--force"]);
    let skipped = make(&["--skip-existing"]).succeeds();
    assert!(skipped.out.is_empty() && skipped.err.contains("box.tmpi"), "{}{}", skipped.out, skipped.err);
    assert!(std::fs::read(f.path("box.tmpi")).unwrap() == first);
    make(&["--force"]).succeeds();
    assert!(std::fs::read(f.path("box.tmpi")).unwrap() != first, "another photo file gives another container");
}

#[test]
fn pictures_of_all_directions_are_refused_with_what_helps() {
    let f = Folder::new();
    let plain = std::fs::read(f.path("box.jpg")).unwrap();
    // a whole sphere, and the half of it that VR180 shows
    for (name, cropped) in [("360.jpg", ""), ("180.jpg", "GPano:CroppedAreaImageWidthPixels='1800' GPano:FullPanoWidthPixels='3600'")] {
        let packet = format!(
            "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description \
             xmlns:GPano='http://ns.google.com/photos/1.0/panorama/' GPano:ProjectionType='equirectangular' {cropped}/></rdf:RDF></x:xmpmeta>"
        );
        let body = [b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat();
        f.write(name, &with_segments(&plain, &[segment(0xE1, &body)]));
        f.run(&["make", name, "-o", "x.tmpi", "-q"]).fails(1, &[name, "360°", "stereo none"]);
        f.run(&["depth", name, "-o", "x.png", "-q"]).fails(1, &[name, "360°"]);
        f.run(&["make", name, "--depth", "depth.png", "--stereo", "none", "-o", name.replace("jpg", "tmpi").as_str(), "-q"]).succeeds();
    }
    assert!(!f.path("x.tmpi").exists());
}

#[test]
fn make_continues_a_partly_finished_folder() {
    let f = Folder::new();
    for name in ["in/a.png", "in/sub/b.png", "in/sub/deep/c.png"] {
        std::fs::create_dir_all(f.path(name).parent().unwrap()).unwrap();
        std::fs::copy(f.path("box.png"), f.path(name)).unwrap();
    }
    f.write("in/notes.txt", b"no photo");
    f.write("in/x.heic", b"unread");
    std::fs::create_dir(f.path("empty")).unwrap();
    f.run(&["make", "empty", "-o", "out"]).fails(1, &["empty", "no JPEG"]);
    f.run(&["make", "in", "-o", "out", "--depth", "depth.png"]).fails(2, &["--depth"]);
    if !f.has_depth() {
        return;
    }
    let first = f.run(&["make", "in", "-o", "out", "--jobs", "2"]).succeeds();
    assert_eq!(first.out.lines().count(), 3, "{}", first.out);
    assert!(first.err.contains("1 .heic") && !first.err.contains("notes.txt"), "{}", first.err);
    let times = || ["a", "sub/b", "sub/deep/c"].map(|n| std::fs::metadata(f.path(&format!("out/{n}.tmpi"))).unwrap().modified().unwrap());
    let before = times();
    std::fs::remove_file(f.path("out/sub/b.tmpi")).unwrap();
    let second = f.run(&["make", "in", "-o", "out"]).succeeds();
    assert!(second.err.contains("2 of 3 are there already") && second.out.lines().count() == 1, "{}{}", second.out, second.err);
    let after = times();
    assert!(after[0] == before[0] && after[1] > before[1] && after[2] == before[2]);
    f.run(&["make", "in", "-o", "out", "--force", "-q"]).succeeds();
    assert!(times().iter().zip(&after).all(|(new, old)| new > old));
}

#[test]
fn depth_writes_png_and_raw_pfm() {
    let f = Folder::new();
    if !f.has_depth() {
        return;
    }
    let run = f.run(&["depth", "box.jpg", "-o", "d.png", "--json"]).succeeds();
    has(&run.json(), &["width", "height", "model", "least", "greatest"]);
    let DynamicImage::ImageLuma16(map) = image::open(f.path("d.png")).unwrap() else { panic!("not 16-bit grey") };
    assert_eq!(map.dimensions(), (150, 100));
    assert!(map.pixels().map(|p| p.0[0]).max().unwrap() > map.pixels().map(|p| p.0[0]).min().unwrap());
    let pfm = std::fs::read(f.path("probe.pfm")).unwrap();
    assert!(pfm.starts_with(b"Pf\n"));
    let flipped = f.run(&["depth", "box.jpg", "-q", "--flip", "--raw", "-o", "flip.pfm"]).succeeds();
    assert!(flipped.out.contains("disparity"));
    f.run(&["depth", "box.jpg", "-q", "--depth-smoothing", "0", "-o", "rough.png"]).succeeds();
    assert_ne!(std::fs::read(f.path("rough.png")).unwrap(), std::fs::read(f.path("d.png")).unwrap());
    assert!(f.run(&["depth", "box.jpg", "--depth-smoothing", "-1", "-o", "no.png"]).code == 2);
    let sized = f.run(&["depth", "box.jpg", "-q", "--raw", "--depth-pixels", "6000", "-o", "sized.pfm"]).succeeds();
    assert!(sized.out.contains("96×64"), "{}", sized.out);
    assert!(f.run(&["depth", "box.jpg", "--depth-pixels", "10", "-o", "no.png"]).err.contains("1024..=2000000"));
    // `make` accepts the written map
    f.run(&["make", "box.jpg", "--depth", "d.png", "-q", "-o", "again.tmpi"]).succeeds();
}
