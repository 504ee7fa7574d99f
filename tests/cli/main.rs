//! Tests the command line of the built program: exit codes, output streams, JSON, files.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

mod config;
mod fixture;
mod making;
mod rendering;
#[cfg(unix)]
mod watch;

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

/// As in `tmpi make … 2>&1 | head`: the program continues after the reader has closed the pipe.
#[cfg(unix)]
#[test]
fn a_closed_pipe_does_not_stop_the_program() {
    let f = Folder::new();
    for json in [&[][..], &["--json"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        let mut command = f.command();
        command.args(["make", "box.png", "--depth", "depth.png", "--force", "-o", "box.tmpi"]).args(json);
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
    let run = Run::from(f.command().args(["info", "box.tmpi"]).stdout(writer).stderr(std::process::Stdio::piped()).output().unwrap());
    assert_eq!((run.code, run.err.as_str()), (0, ""));
}

/// A missing GPU, a missing file: the program prints each error once.
#[test]
fn errors_are_printed_once() {
    let f = Folder::new();
    f.container();
    let plain = |args: &[&str]| Run::from(f.command().env_remove("XDG_RUNTIME_DIR").args(args).output().unwrap());
    let drawn = plain(&["render", "box.tmpi", "-o", "v.png"]);
    assert_eq!((drawn.code, drawn.err.as_str()), (0, ""));
    let run = plain(&["make", "nosuch.jpg", "-o", "x.tmpi"]);
    assert_eq!((run.code, run.err.matches("o such file").count()), (1, 1), "{}", run.err);
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
