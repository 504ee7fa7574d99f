//! Detects the adapter of a model file by its name and its graph.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use super::{ADAPTERS, Adapter, adapter};
use crate::networks::{OnnxGraph, onnx_graph};

/// Words of a file's name that identify a network, the more specific ones first, and its adapter.
const WORDS: [(&[&str], &str); 12] = [
    (&["depth-anything-v3"], "depth-anything-3"),
    (&["depthanything3"], "depth-anything-3"),
    (&["depthanythingv3"], "depth-anything-3"),
    (&["moge2"], "moge-2"),
    (&["depth-anything", "metric"], "depth-anything-v2-metric"),
    (&["depth-anything"], "depth-anything-v2"),
    (&["dpt", "hybrid"], "dpt-hybrid"),
    (&["dpt", "large"], "dpt-large"),
    (&["midas", "small"], "midas-v2.1-small"),
    (&["midas"], "midas-v2.1"),
    // file names of the MiDaS project
    (&["model-small"], "midas-v2.1-small"),
    (&["model-f6b98070"], "midas-v2.1"),
];

/// Detects the adapter of an ONNX file: by words of its name, else of the three folders above it, else by its graph: the names of its
/// inputs and outputs, else its fixed size. Returns `None` if nothing identifies it.
pub fn detect(file: &Path) -> Option<&'static Adapter> {
    let graph = File::open(file).ok().and_then(|f| onnx_graph(&mut BufReader::new(f)));
    let named = file.ancestors().take(4).filter_map(|p| p.file_name()?.to_str()).find_map(by_name);
    named.map_or_else(|| graph.as_ref().and_then(by_graph), |found| Some(normalised(found, graph.as_ref())))
}

/// The adapter with the longest name that `name` contains, else the one that its words identify.
fn by_name(name: &str) -> Option<&'static Adapter> {
    let name = name.to_lowercase().replace(['_', ' '], "-");
    // the embedded network has the program's name, which identifies nothing
    let named = ADAPTERS[1..].iter().filter(|a| name.contains(a.name)).max_by_key(|a| a.name.len());
    let worded = || WORDS.iter().find(|(words, _)| words.iter().all(|w| name.contains(w))).and_then(|w| adapter(w.1));
    // the project's own names are too short to search for inside words
    let da3 = |word: &str| word.strip_prefix("da3").is_some_and(|rest| ["", "small", "base", "large", "metric", "mono"].contains(&rest));
    let short = || name.split(['-', '.']).any(da3).then(|| adapter("depth-anything-3")).flatten();
    named.or_else(short).or_else(worded)
}

fn by_graph(graph: &OnnxGraph) -> Option<&'static Adapter> {
    let gives = |name: &str| graph.outputs.iter().any(|o| o == name);
    let depth = gives("depth") || gives("predicted_depth");
    if gives("points") && gives("mask") && (gives("metric_scale") || gives("scale")) {
        return adapter("moge-2");
    }
    // besides depth it returns sky, a confidence or, for several pictures, their cameras
    if depth && (gives("sky") || gives("depth_conf") || graph.shape.len() == 5 && (gives("confidence") || gives("extrinsics"))) {
        return adapter("depth-anything-3");
    }
    let [_, _, h, w] = graph.shape[..] else { return None };
    let name = match (w, h) {
        (256, 256) => "midas-v2.1-small",
        // the name in `transformers`
        (384, 384) if graph.input == "pixel_values" => "dpt-large",
        (384, 384) => "midas-v2.1",
        (14.., 14..) if w % 14 == 0 && h % 14 == 0 && (w % 32 != 0 || h % 32 != 0) => "depth-anything-v2",
        _ => return None,
    };
    adapter(name).map(|found| normalised(found, Some(graph)))
}

/// Chooses the kind of `MiDaS` file that fits the graph: one kind normalises its input itself, that of the torch hub does not.
fn normalised(found: &'static Adapter, graph: Option<&OnnxGraph>) -> &'static Adapter {
    let plain = graph.is_some_and(|o| !o.normalises) && matches!(found.name, "midas-v2.1" | "midas-v2.1-small");
    if plain { adapter(&format!("{}-hub", found.name)).unwrap_or(found) } else { found }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_files_are_detected_by_their_names() {
        for (file, want) in [
            ("model-small.onnx", "midas-v2.1-small"),
            ("model-f6b98070.onnx", "midas-v2.1"),
            ("MiDaS_small.onnx", "midas-v2.1-small"),
            ("midas-v2.1-small-hub-256x160.onnx", "midas-v2.1-small-hub"),
            ("dpt_hybrid-midas-501f0c75.onnx", "dpt-hybrid"),
            ("dpt_large_384.onnx", "dpt-large"),
            ("depth_anything_v2_vits.onnx", "depth-anything-v2"),
            ("depth-anything-v2-small/onnx/model.onnx", "depth-anything-v2"),
            ("Depth-Anything-V2-Metric-Indoor-Small-hf/model.onnx", "depth-anything-v2-metric"),
            ("depth_anything_metric_depth_indoor.onnx", "depth-anything-v2-metric"),
            ("depth-anything-3-small.onnx", "depth-anything-3"),
            ("depth-anything-v3-small/onnx/model.onnx", "depth-anything-3"),
            ("Depth-Anything-3-Onnx/da3metric-large_504.onnx", "depth-anything-3"),
            ("DA3MONO-LARGE/model.onnx", "depth-anything-3"),
            ("depth_anything_v2_5fda3c.onnx", "depth-anything-v2"),
            ("da3f00/depth_anything_v2.onnx", "depth-anything-v2"),
            ("da3.onnx", "depth-anything-3"),
            ("DepthAnything3_ONNX/small.onnx", "depth-anything-3"),
            ("moge-2-vits-normal-onnx/model.onnx", "moge-2"),
            ("moge2-vitb-normal.onnx", "moge-2"),
        ] {
            assert_eq!(detect(Path::new(file)).map(|a| a.name), Some(want), "{file}");
        }
        assert_eq!(detect(Path::new("models/depth.onnx")), None);
    }

    #[test]
    fn unnamed_files_are_detected_by_their_graph() {
        let of = |input: &str, w, h, normalises| {
            by_graph(&OnnxGraph { input: input.into(), shape: vec![1, 3, h, w], normalises, ..OnnxGraph::default() }).map(|a| a.name)
        };
        assert_eq!(of("0", 256, 256, true), Some("midas-v2.1-small"));
        assert_eq!(of("0", 384, 384, true), Some("midas-v2.1"));
        assert_eq!(of("0", 384, 384, false), Some("midas-v2.1-hub"));
        assert_eq!(of("pixel_values", 384, 384, false), Some("dpt-large"));
        assert_eq!(of("image", 518, 518, false), Some("depth-anything-v2"));
        assert_eq!(of("image", 686, 518, false), Some("depth-anything-v2"));
        assert_eq!(of("image", -1, -1, false), None);
        assert_eq!(of("image", 448, 224, false), None);
    }

    #[test]
    fn unnamed_files_are_detected_by_their_outputs() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("m.onnx");
        let tests = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/onnx"));
        for (fixture, want) in [("points", Some("moge-2")), ("views", Some("depth-anything-3")), ("mean", None)] {
            std::fs::copy(tests.join(fixture).with_extension("onnx"), &file).unwrap();
            assert_eq!(detect(&file).map(|a| a.name), want, "{fixture}");
        }
        let of = |shape: &[i64], outputs: &[&str]| {
            let outputs = outputs.iter().map(|o| (*o).to_owned()).collect();
            by_graph(&OnnxGraph { input: "image".into(), shape: shape.to_vec(), outputs, ..OnnxGraph::default() }).map(|a| a.name)
        };
        assert_eq!(of(&[1, 3, 504, 504], &["depth", "sky"]), Some("depth-anything-3"), "not disparity, as its size alone would say");
        assert_eq!(of(&[1, -1, 3, 504, 504], &["depth", "depth_conf", "extrinsics", "intrinsics"]), Some("depth-anything-3"));
        assert_eq!(of(&[1, 32, 3, 518, 518], &["depth"]), None, "a film of 32 pictures");
        assert_eq!(of(&[1, 3, 518, 518], &["points", "normal", "mask", "scale"]), Some("moge-2"));
        assert_eq!(of(&[-1, 3, -1, -1], &["points", "mask"]), None, "its first version has no scale");
        assert_eq!(of(&[1, 3, 518, 518], &["depth"]), Some("depth-anything-v2"));
    }

    #[test]
    fn a_midas_name_is_checked_against_the_graph() {
        let small = adapter("midas-v2.1-small").unwrap();
        let graph = |normalises| OnnxGraph { input: "x".into(), shape: vec![1, 3, -1, -1], normalises, ..OnnxGraph::default() };
        assert_eq!(normalised(small, Some(&graph(true))).name, "midas-v2.1-small");
        assert_eq!(normalised(small, Some(&graph(false))).name, "midas-v2.1-small-hub");
        assert_eq!(normalised(small, None).name, "midas-v2.1-small");
    }
}
