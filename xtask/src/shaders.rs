//! GLSL for WebGL2, made of the WGSL that everything else draws with.

use std::fmt::Write as _;
use std::fs;

use naga::back::glsl::{Options, PipelineOptions, Version, Writer, WriterFlags};
use naga::proc::BoundsCheckPolicies;
use naga::valid::{Capabilities, ValidationFlags, Validator};

use crate::command::{Fault, root};

/// Where the shaders lie.
const FOLDER: &str = "static/draw";
/// What is made, below [`FOLDER`].
const MADE: &str = "glsl.js";

/// WGSL files, and the entry points that are translated with the names that scripts have for them.
const SHADERS: [(&str, &[(&str, &str)]); 2] = [
    ("tmpi.wgsl", &[("vs_webgl", "SCENE_VERTEX"), ("fs_opaque", "OPAQUE_FRAGMENT"), ("fs_soft", "SOFT_FRAGMENT")]),
    ("copy.wgsl", &[("vs", "COPY_VERTEX"), ("fs", "COPY_FRAGMENT")]),
];

/// Writes the module of GLSL texts.
pub fn write() -> Result<(), Fault> {
    let path = root().join(FOLDER).join(MADE);
    fs::write(&path, module()?).map_err(|e| Fault::new(format!("{}: {e}", path.display())))
}

/// The module as the WGSL files are now.
fn module() -> Result<String, Fault> {
    let mut out = String::from("// Made of the WGSL files beside this one by `cargo xtask shaders`: change those.\n");
    for (file, entries) in SHADERS {
        let path = root().join(FOLDER).join(file);
        let source = fs::read_to_string(&path).map_err(|e| Fault::new(format!("{}: {e}", path.display())))?;
        let broken = |what: &str, e: &dyn std::fmt::Display| Fault::new(format!("{file}: {what}: {e}"));
        let parsed = naga::front::wgsl::parse_str(&source).map_err(|e| broken("WGSL", &e.emit_to_string(&source)))?;
        let info = Validator::new(ValidationFlags::all(), Capabilities::empty())
            .validate(&parsed)
            .map_err(|e| broken("WGSL", &e.emit_to_string(&source)))?;
        for (entry, name) in entries {
            let text = translated(&parsed, &info, entry).map_err(|e| broken(entry, &e))?;
            // in a literal of the script these would mean something else
            if text.contains(['`', '\\']) || text.contains("${") {
                return Err(broken(entry, &"the GLSL cannot stand in a script"));
            }
            // writing to a string does not fail
            let _ = write!(out, "\n/** `{entry}` of {file}. */\nexport const {name} = `{}\n`;\n", text.trim_end());
        }
    }
    Ok(out)
}

/// An entry point as GLSL ES 3.00.
fn translated(module: &naga::Module, info: &naga::valid::ModuleInfo, entry: &str) -> Result<String, Fault> {
    let found = module.entry_points.iter().find(|e| e.name == entry).ok_or_else(|| Fault::new("there is no such entry point"))?;
    let options = Options {
        version: Version::Embedded { version: 300, is_webgl: true },
        // clip space is that of the entry point: pictures stay upright
        writer_flags: WriterFlags::empty(),
        ..Options::default()
    };
    let pipeline = PipelineOptions { shader_stage: found.stage, entry_point: entry.to_owned(), multiview: None };
    let mut text = String::new();
    Writer::new(&mut text, module, info, &options, &pipeline, BoundsCheckPolicies::default())
        .and_then(|mut writer| writer.write())
        .map_err(|e| Fault::new(e.to_string()))?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_glsl_is_that_of_the_wgsl() {
        let want = module().unwrap_or_else(|e| panic!("{e}"));
        let have = fs::read_to_string(root().join(FOLDER).join(MADE)).unwrap();
        assert!(want == have, "{FOLDER}/{MADE} is stale: run `cargo xtask shaders`");
    }
}
