//! GLSL for WebGL2, made of the WGSL that everything else draws with: `TMPI_BLESS=shaders cargo test --workspace --test shaders` writes it.
#![allow(clippy::unwrap_used, reason = "test")]

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use naga::back::glsl::{Options, PipelineOptions, Version, Writer, WriterFlags};
use naga::proc::BoundsCheckPolicies;
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

/// Where the shaders lie.
const FOLDER: &str = "../../static/draw";
/// What is made, below [`FOLDER`].
const MADE: &str = "glsl.js";

/// WGSL files, and the entry points that are translated with the names that scripts have for them.
const SHADERS: [(&str, &[(&str, &str)]); 2] = [
    ("tmpi.wgsl", &[("vs_webgl", "SCENE_VERTEX"), ("fs_opaque", "OPAQUE_FRAGMENT"), ("fs_soft", "SOFT_FRAGMENT")]),
    ("copy.wgsl", &[("vs", "COPY_VERTEX"), ("fs", "COPY_FRAGMENT")]),
];

fn path(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(FOLDER).join(file)
}

/// The module of GLSL texts as the WGSL files are now.
fn module() -> String {
    let mut out =
        String::from("// Made of the WGSL files beside this one by `TMPI_BLESS=shaders cargo test --test shaders`: change those.\n");
    for (file, entries) in SHADERS {
        let source = fs::read_to_string(path(file)).unwrap();
        let parsed = naga::front::wgsl::parse_str(&source).unwrap_or_else(|e| panic!("{file}: {}", e.emit_to_string(&source)));
        let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&parsed);
        let info = info.unwrap_or_else(|e| panic!("{file}: {}", e.emit_to_string(&source)));
        for (entry, name) in entries {
            let text = translated(&parsed, &info, entry);
            assert!(!text.contains(['`', '\\']) && !text.contains("${"), "{file}: {entry} cannot stand in a literal of a script");
            write!(out, "\n/** `{entry}` of {file}. */\nexport const {name} = `{}\n`;\n", text.trim_end()).unwrap();
        }
    }
    out
}

/// An entry point as GLSL ES 3.00.
fn translated(module: &naga::Module, info: &ModuleInfo, entry: &str) -> String {
    let found = module.entry_points.iter().find(|e| e.name == entry).unwrap();
    let options = Options {
        version: Version::Embedded { version: 300, is_webgl: true },
        // clip space is that of the entry point: pictures stay upright
        writer_flags: WriterFlags::empty(),
        ..Options::default()
    };
    let pipeline = PipelineOptions { shader_stage: found.stage, entry_point: entry.to_owned(), multiview: None };
    let mut text = String::new();
    Writer::new(&mut text, module, info, &options, &pipeline, BoundsCheckPolicies::default()).unwrap().write().unwrap();
    text
}

#[test]
fn the_glsl_is_that_of_the_wgsl() {
    let want = module();
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "shaders") {
        fs::write(path(MADE), &want).unwrap();
    }
    let have = fs::read_to_string(path(MADE)).unwrap();
    assert!(want == have, "{MADE} is stale: `TMPI_BLESS=shaders cargo test --workspace --test shaders` writes it");
}
