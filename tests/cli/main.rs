//! Tests the command line of the built program: exit codes, output streams, JSON, files.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

mod config;
mod fixture;
#[cfg(unix)]
mod watch;

use std::path::Path;
use std::process::Command;

use image::DynamicImage;
use serde_json::Value;

use tmpi_testing::Need;
use tmpi_testing::jpeg::{segment, with_segments};

use fixture::{Folder, Run, has};

#[test]
fn help_and_version_go_to_standard_output() {
    let folder = Folder::new();
    for args in [vec!["--help"], vec!["make", "--help"], vec!["--version"]] {
        let run = folder.run(&args).succeeds();
        assert!(!run.out.is_empty() && run.err.is_empty());
    }
    assert!(folder.run(&["completions", "bash"]).succeeds().out.contains("_tmpi"));
    // each command lists only its own options
    let depth = folder.run(&["depth", "--help"]).succeeds().out;
    for flag in ["--planes", "--tile", "--verify-prune", "--budget-ms", "--view-box", "--quality"] {
        assert!(!depth.contains(flag), "{flag} does not apply to a depth map: {depth}");
        folder.run(&["depth", "box.png", "-o", "x.png", flag, "1"]).fails(2, &[flag]);
    }
    assert!(depth.contains("--photo-depth") && depth.contains("--max-size"));
}

#[test]
fn usage_errors_name_the_option_and_its_range() {
    let f = Folder::new();
    let make = |extra: &[&str]| f.run(&[&["make", "box.png", "-o", "x.tmpi"], extra].concat());
    make(&["--planes", "65"]).fails(2, &["--planes", "1 to 64"]);
    make(&["--planes", "0"]).fails(2, &["--planes"]);
    make(&["--tile", "7"]).fails(2, &["--tile", "8 to 1024"]);
    make(&["--fov-x", "nan"]).fails(2, &["--fov-x", "180"]);
    make(&["--fov-x", "180"]).fails(2, &["--fov-x"]);
    make(&["--quality", "0"]).fails(2, &["--quality", "1 to 100"]);
    make(&["--quality", "1000"]).fails(2, &["--quality", "not 1000"]);
    make(&["--max-size", "16385"]).fails(2, &["--max-size", "16384"]);
    make(&["--max-error", "nan"]).fails(2, &["--max-error"]);
    make(&["--view-box", "1,1"]).fails(2, &["--view-box"]);
    make(&["--view-box", "inf,0,0"]).fails(2, &["--view-box"]);
    make(&["--plane-method", "guess"]).fails(2, &["--plane-method", "slanted"]);
    make(&["--depth-model", "nosuch"]).fails(2, &["--depth-model", "tmpi"]);
    make(&["box.jpg", "--depth", "depth.png"]).fails(2, &["--depth"]);
    f.run(&["make", "box.png"]).fails(2, &["--output"]);
    f.run(&["make", "box.png", "-o", "box.png"]).fails(2, &[".tmpi"]);
    f.run(&["make", "box.png", "-o", "out.jpg"]).fails(2, &["out.tmpi", "Usage: tmpi make"]);
    f.run(&["make", "box.png", "box.jpg", "-o", "all.tmpi"]).fails(2, &["folder"]);
    f.run(&["make", "box.png", "-o", "x.tmpi", "--force", "--skip-existing"]).fails(2, &["--skip-existing"]);
    f.run(&["serve", "--addr", "nowhere"]).fails(2, &["--addr", "127.0.0.1:8080"]);
    f.run(&["make", "box.png", "box.jpg", "-o", "out"]).fails(2, &["out/box.tmpi"]);
    f.run(&["depth", "box.png", "-o", "x.tif"]).fails(2, &[".png or .pfm"]);
    let render = |extra: &[&str]| f.run(&[&["render", "box.tmpi", "-o", "x.png"], extra].concat());
    render(&["--pose", "0,0"]).fails(2, &["--pose"]);
    render(&["--pose", "nan,0,0"]).fails(2, &["--pose", "finite"]);
    render(&["--size", "16385x1"]).fails(2, &["--size", "16384"]);
    render(&["--size", "0x5"]).fails(2, &["--size"]);
    render(&["--stereo", "both"]).fails(2, &["--stereo", "half-sbs"]);
    render(&["--stereo", "sbs", "--ipd", "0"]).fails(2, &["--ipd"]);
    f.run(&["render", "box.tmpi", "-o", "x.mpo", "--stereo", "crossed"]).fails(2, &["--stereo sbs"]);
    render(&["--ipd", "0.1"]).fails(2, &["--stereo", "--quilt"]);
    render(&["--quilt", "11x10"]).fails(2, &["--quilt"]);
    render(&["--frames", "5"]).fails(2, &["--path"]);
    f.run(&["render", "box.tmpi", "-o", "x.gif"]).fails(2, &[".webp", "Usage: tmpi render"]);
    f.run(&["export", "box.tmpi", "-o", "x.gltf"]).fails(2, &["x.gltf", ".glb"]);
    f.run(&["export", "box.tmpi", "-o", "x.glb", "--title", "x"]).fails(2, &["--title"]);
    f.run(&["nonsense"]).fails(2, &["nonsense"]);
}

#[test]
fn failures_leave_nothing_behind() {
    let f = Folder::new();
    f.write("broken.jpg", &std::fs::read(f.path("box.jpg")).unwrap()[..900]);
    f.write("text.txt", b"no photo");
    let before = f.names();
    f.run(&["make", "nosuch.jpg", "-o", "x.tmpi"]).fails(1, &["nosuch.jpg"]);
    f.run(&["make", "broken.jpg", "--depth", "depth.png", "-q", "-o", "x.tmpi"]).fails(1, &["broken.jpg", "cut short"]);
    f.run(&["make", "text.txt", "--depth", "depth.png", "-q", "-o", "x.tmpi"]).fails(1, &["not a JPEG"]);
    f.run(&["make", "box.png", "--depth", "text.txt", "-q", "-o", "x.tmpi"]).fails(1, &["depth map", "PNG"]);
    f.run(&["info", "box.png"]).fails(1, &["box.png", "not a readable TMPI container"]);
    f.run(&["render", "nosuch.tmpi", "-o", "x.png"]).fails(1, &["nosuch.tmpi"]);
    assert_eq!(f.names(), before);
    f.container();
    let whole = std::fs::read(f.path("box.tmpi")).unwrap();
    f.write("cut.tmpi", &whole[..whole.len() / 2]);
    f.run(&["info", "cut.tmpi", "--json"]).fails(1, &["cut.tmpi"]);
}

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

/// As in `tmpi make … 2>&1 | head`: the program continues after the reader has closed the pipe.
#[cfg(unix)]
#[test]
fn a_closed_pipe_does_not_stop_the_program() {
    let f = Folder::new();
    for json in [&[][..], &["--json"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
        command.current_dir(f.path("")).args(["make", "box.png", "--depth", "depth.png", "--force", "-o", "box.tmpi"]).args(json);
        command.stdout(writer.try_clone().unwrap()).stderr(writer);
        let mut child = command.spawn().unwrap();
        // `command` also owns a write end of the pipe
        drop((reader, command));
        assert_eq!(child.wait().unwrap().code(), Some(0));
        std::fs::remove_file(f.path("box.tmpi")).unwrap();
    }
    f.container();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.current_dir(f.path("")).args(["info", "box.tmpi"]).stdout(writer).stderr(std::process::Stdio::piped());
    let run = Run::from(command.output().unwrap());
    assert_eq!((run.code, run.err.as_str()), (0, ""));
}

/// A missing GPU, a missing file: the program prints each error once.
#[test]
fn errors_are_printed_once() {
    let f = Folder::new();
    f.container();
    let plain = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
        command.current_dir(f.path("")).env_remove("XDG_RUNTIME_DIR").env_remove("RUST_LOG").args(args);
        Run::from(command.output().unwrap())
    };
    let drawn = plain(&["render", "box.tmpi", "-o", "v.png"]);
    assert_eq!((drawn.code, drawn.err.as_str()), (0, ""));
    let run = plain(&["make", "nosuch.jpg", "-o", "x.tmpi"]);
    assert_eq!((run.code, run.err.matches("o such file").count()), (1, 1), "{}", run.err);
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

#[test]
fn info_describes_a_container() {
    let f = Folder::new();
    let info = f.container().run(&["info", "box.tmpi", "--json"]).succeeds().json();
    has(&info, &["bytes", "version", "width", "height", "tile.size", "tiles", "planes", "planes_per_tile", "fov_x", "intrinsics.fx"]);
    has(&info, &["texels.photo", "texels.hidden", "view_box.x"]);
    let sections = info["sections"].as_array().unwrap();
    assert!(sections.iter().any(|s| s["kind"] == "photo"));
    let last = sections.iter().map(|s| s["offset"].as_u64().unwrap() + s["bytes"].as_u64().unwrap()).max();
    assert_eq!(last, info["bytes"].as_u64());
    let text = f.run(&["info", "box.tmpi"]).succeeds().out;
    assert!(text.contains("150×100") && text.contains("section"));
    assert!(info["texels"]["hidden"].as_u64() > Some(0));
    assert!(sections.iter().all(|s| s["kind"] != "hidden"), "hidden colours are not stored");
    let share =
        |kind: &str| text.lines().find(|l| l.starts_with(kind)).and_then(|l| l.split('%').next()?.rsplit(' ').next()?.parse::<f64>().ok());
    let total: f64 = ["header", "photo     jpeg", "planes    range", "labels"].iter().map(|k| share(k).unwrap()).sum();
    assert!((total - 100.0).abs() < 0.3, "{total} %:\n{text}");
}

/// Some drivers crash at exit unless the program releases them first.
#[test]
fn rendering_on_a_gpu_exits_without_a_crash() {
    let f = Folder::new();
    f.container();
    for _ in 0..12 {
        let run = f.run(&["render", "box.tmpi", "-o", "v.png", "--backend", "gpu"]);
        let found = if run.code == 1 && run.err.contains("no adapter") { Err(run.err) } else { Ok(run) };
        let Some(run) = Need::Gpu.or_skip(found) else { return };
        run.succeeds();
    }
}

#[test]
fn render_writes_every_format() {
    let f = Folder::new();
    f.container();
    let render = |out: &str, extra: &[&str]| {
        let run = f.run(&[&["render", "box.tmpi", "-o", out, "--backend", "cpu", "--json"], extra].concat()).succeeds();
        let lines: Vec<Value> = run.out.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let outside = lines.iter().any(|l| l["outside_view_box"] == true);
        assert_eq!((run.err.matches("view box").count(), run.err.lines().count()), (outside.into(), outside.into()), "{}", run.err);
        (lines, f.path(out))
    };
    let (lines, path) = render("same.png", &[]);
    has(&lines[0], &["output", "width", "height", "backend", "pose.tx", "ms"]);
    let scene = tmpi_core::container::decode(&std::fs::read(f.path("box.tmpi")).unwrap()).unwrap();
    let same = image::open(path).unwrap().to_rgba8();
    assert!(same.pixels().all(|p| p.0[3] == 255), "the reference view has no holes");
    let same = DynamicImage::from(same).to_rgb8();
    assert!(same.as_raw() == scene.photo.rgb.as_flattened(), "the reference view equals the photo in the container");
    // a view from far to the side has holes: transparent in PNG and WebP, black in JPEG
    for (name, alpha) in [("side.png", true), ("side.webp", true), ("side.jpg", false)] {
        let (lines, path) = render(name, &["--pose=4,0,0", "--size", "90x60"]);
        assert_eq!(lines[0]["outside_view_box"], true);
        let image = image::open(path).unwrap();
        assert_eq!((image.width(), image.height(), image.color().has_alpha()), (90, 60, alpha));
        let corner = image.to_rgba8().get_pixel(89, 30).0;
        assert!(if alpha { corner[3] < 255 } else { corner[0] < 16 }, "{name}: {corner:?}");
    }
    assert_eq!(render("within.png", &["--pose=0.02,0.03,-0.03"]).0[0]["outside_view_box"], false);
    let box_parallax = |name: &str, focus: &[&str]| {
        let (_, path) = render(name, &[&["--stereo", "sbs", "--ipd", "0.05"], focus].concat());
        let pair = image::open(path).unwrap().to_rgb8();
        let edge = |x0: u32| i64::from((x0..x0 + 150).find(|&x| pair.get_pixel(x, 50).0[0] > 150).unwrap() - x0);
        edge(0) - edge(150)
    };
    // by default the focus is on the wall, which fills most of the photo; the box moves by their difference in disparity
    let (default, far, near) =
        (box_parallax("u.png", &[]), box_parallax("n.png", &["--focus", "0"]), box_parallax("f.png", &["--focus", "0.915"]));
    assert!(near.abs() <= 1 && far >= default && default > near, "{far} {default} {near}");
    let (_, path) = render("pair.png", &["--stereo", "sbs", "--ipd", "0.1", "--focus", "0"]);
    let pair = image::open(path).unwrap().to_rgb8();
    assert_eq!(pair.dimensions(), (300, 100));
    let left_edge = |x0: u32| (x0..x0 + 150).find(|&x| pair.get_pixel(x, 50).0[0] > 150).unwrap() - x0;
    assert!(left_edge(0) > left_edge(150), "the left eye sees the box farther to the right");
    let (_, path) = render("pair.mpo", &["--stereo", "sbs"]);
    assert_eq!(image::load_from_memory_with_format(&std::fs::read(path).unwrap(), image::ImageFormat::Jpeg).unwrap().width(), 150);
    let (_, path) = render("red-cyan.png", &["--stereo", "anaglyph", "--ipd", "0.1"]);
    assert_eq!(image::open(path).unwrap().to_rgb8().dimensions(), (150, 100));
    let (_, path) = render("quilt.png", &["--quilt", "4x2", "--size", "60x40"]);
    assert_eq!(image::open(path).unwrap().to_rgb8().dimensions(), (240, 80));
    f.run(&["render", "box.tmpi", "-o", "q.png", "--quilt", "10x10", "--size", "2000x1000"]).fails(2, &["--size"]);
    let (lines, _) = render("frames/f.jpg", &["--path", "swing", "--frames", "3"]);
    assert_eq!(lines.len(), 3);
    for n in 1..=3 {
        assert!(f.path(&format!("frames/f-000{n}.jpg")).is_file());
    }
    let wide = render("wide.png", &["--fov-x", "120"]).1;
    assert!(image::open(wide).unwrap().to_rgba8().get_pixel(0, 0).0[3] < 255, "a wider view sees beyond the photo");
}

#[test]
fn exports_are_readable_by_other_programs() {
    let f = Folder::new();
    f.container();
    for (ending, first) in [("html", b"<!do"), ("glb", b"glTF"), ("ora", b"PK\x03\x04"), ("rgbd.png", b"\x89PNG"), ("zip", b"PK\x03\x04")] {
        let name = format!("out/box.{ending}");
        let run = f.run(&["export", "box.tmpi", "-o", &name, "--json"]).succeeds();
        let about = run.json();
        has(&about, &["output", "format", "bytes", "container_bytes", "ms"]);
        let bytes = std::fs::read(f.path(&name)).unwrap();
        assert_eq!((&bytes[..4], about["bytes"].as_u64()), (first.as_slice(), Some(bytes.len() as u64)));
        // exports are reproducible
        let again = format!("again.{ending}");
        f.run(&["export", "box.tmpi", "-o", &again, "--json"]).succeeds();
        assert!(std::fs::read(f.path(&again)).unwrap() == bytes, "{ending}");
    }
    // the ending says that the right half is the depth map
    let again = f.run(&["make", "out/box.rgbd.png", "-o", "rgbd.tmpi", "--json", "-q"]).succeeds().json();
    assert_eq!((&again["report"]["input"]["depth"]["source"], &again["report"]["width"]), (&"rgbd".into(), &150.into()));
    f.run(&["export", "box.tmpi", "-o", "far.glb", "--metric"]).succeeds();
    assert!(std::fs::read(f.path("far.glb")).unwrap() != std::fs::read(f.path("out/box.glb")).unwrap());
    f.run(&["export", "box.tmpi", "-o", "x.ora", "--metric"]).fails(2, &["--metric", "Usage: tmpi export"]);
    f.run(&["export", "box.tmpi", "-o", "titled.html", "--title", "A <box>"]).succeeds();
    assert!(std::fs::read_to_string(f.path("titled.html")).unwrap().contains("<title>A &lt;box&gt;</title>"));
    f.run(&["export", "box.tmpi", "-o", "part.tmpi", "--region", "0,0,9,9", "--lossless"]).succeeds();
    f.run(&["export", "box.tmpi", "-o", "small.tmpi", "--level", "1"]).succeeds();
    f.run(&["export", "box.tmpi", "-o", "part.glb", "--region", "0,0,9,9"]).succeeds();
    let width = |name: &str| f.run(&["info", name, "--json"]).succeeds().json()["width"].as_u64().unwrap();
    assert_eq!((width("part.tmpi"), width("small.tmpi")), (64, width("box.tmpi").div_ceil(2)));
    assert!(std::fs::metadata(f.path("part.glb")).unwrap().len() < std::fs::metadata(f.path("out/box.glb")).unwrap().len());
    f.run(&["export", "box.tmpi", "-o", "x.tmpi", "--region", "0,0,9999,9"]).fails(2, &["--region"]);
    f.run(&["export", "box.tmpi", "-o", "x.tmpi", "--region", "0,0,9"]).fails(2, &["--region", "four whole numbers"]);
    f.run(&["export", "box.tmpi", "-o", "x.tmpi", "--lossless"]).fails(2, &["--region"]);
    f.run(&["export", "box.tmpi", "-o", "x.tmpi", "--level", "4"]).fails(2, &["--level"]);
    f.write("broken.tmpi", b"TMPI but no more");
    f.run(&["export", "broken.tmpi", "-o", "broken.html"]).fails(1, &["broken.tmpi"]);
    assert!(!f.path("broken.html").exists());
}

#[test]
fn a_film_needs_a_path_and_ffmpeg() {
    let f = Folder::new();
    f.container();
    f.run(&["render", "box.tmpi", "-o", "way.mp4"]).fails(2, &["--output", ".png"]);
    f.run(&["render", "box.tmpi", "-o", "way.gif", "--path", "orbit"]).fails(2, &[".mp4"]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.current_dir(f.path("")).env("PATH", "").args(["render", "box.tmpi", "-o", "way.mp4", "--path", "swing", "--frames", "3"]);
    Run::from(command.output().unwrap()).fails(1, &["ffmpeg", "not installed"]);
    assert!(!f.path("way.mp4").exists());
    f.run(&["render", "box.tmpi", "-o", "way.png", "--path", "swing", "--frames", "3"]).succeeds();
    assert!(f.path("way-0003.png").exists());
}
