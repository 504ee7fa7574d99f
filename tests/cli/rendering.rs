//! `tmpi render` and `tmpi export`.

use image::DynamicImage;
use serde_json::Value;
use tmpi_testing::Need;

use crate::fixture::{Folder, Run, has};

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
    let film = ["render", "box.tmpi", "-o", "way.mp4", "--path", "swing", "--frames", "3"];
    Run::from(f.command().env("PATH", "").args(film).output().unwrap()).fails(1, &["ffmpeg", "not installed"]);
    assert!(!f.path("way.mp4").exists());
    f.run(&["render", "box.tmpi", "-o", "way.png", "--path", "swing", "--frames", "3"]).succeeds();
    assert!(f.path("way-0003.png").exists());
}
