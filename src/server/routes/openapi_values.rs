//! Writes the allowed values of fields and parameters into the `OpenAPI` document, from the types that parse them: types of other crates
//! have no `utoipa` schemas.

use clap::ValueEnum;
use serde_json::{Value, json};

use crate::export::{ExportFormat, ModelShape, ModelTextures};
use crate::server::photo_options::value_name;
use crate::server::viewer_settings::{VERSION, idle_names};
use tmpi_library::EventType;
use tmpi_pipeline::depth::DepthKind;
use tmpi_pipeline::{Denoise, PlaneMethod, Stereo, Switch};
use tmpi_render::{Path, PictureFormat, StereoLayout};

/// All values of a choice.
fn words<T: ValueEnum>() -> Value {
    T::value_variants().iter().map(value_name).collect()
}

/// Restricts a schema to text that a list of words or a pattern allows.
fn restrict(schema: &mut Value, allowed: Value) {
    let keyword = if allowed.is_array() { "enum" } else { "pattern" };
    schema[keyword] = allowed;
    schema["type"] = "string".into();
}

/// Names of presets.
const PRESET_NAME: &str = "^[A-Za-z0-9_-]+$";

/// Schemas whose parsers refuse unknown fields.
const CLOSED: [&str; 8] = ["Offset", "Settings", "Stroke", "Strokes", "StrokesPatch", "UploadForm", "WebhookOrder", "WebhookPatch"];

/// Writes allowed values, closed schemas and security schemes into `document`.
pub fn add_values(document: &mut Value) {
    for name in CLOSED {
        document["components"]["schemas"][name]["additionalProperties"] = false.into();
    }
    document["components"]["securitySchemes"] = json!({
        "bearer": {"type": "http", "scheme": "bearer", "description": "An API key (`tmpi_k_…`, from `tmpi key add`), an owner's own secret \
            (`tmpi_o_` and 32 to 128 random letters, digits, - and _), or a photo's own token (`tmpi_m_…`, from `manage` in links). Only \
            with `tmpi serve --access private`"},
        "cookie": {"type": "apiKey", "in": "cookie", "name": "tmpi_owner", "description": "An owner's secret or session in a browser"},
    });
    settings(&mut document["components"]["schemas"]);
    // the query may hold the parameters of a file
    document["paths"]["/v1/photos/{id}/exports"]["post"]["requestBody"]["required"] = false.into();
    // no credentials are needed with open access, and for photos that their owner shows to everyone
    document["security"] = json!([{}, {"bearer": []}, {"cookie": []}]);
    let exports = ExportFormat::ALL.map(ExportFormat::name).into_iter();
    let fields = [
        ("PhotoState", "state", json!(["queued", "working", "done", "failed", "damaged"])),
        ("ExportState", "state", json!(["queued", "working", "done", "failed"])),
        ("UploadForm", "class", json!(["interactive", "batch"])),
        ("UploadForm", "denoise", words::<Denoise>()),
        ("UploadForm", "depth_kind", words::<DepthKind>()),
        ("UploadForm", "photo_depth", words::<Switch>()),
        ("UploadForm", "plane_method", words::<PlaneMethod>()),
        ("UploadForm", "planes", json!("^(auto|[0-9]+)$")),
        ("UploadForm", "preset", json!(PRESET_NAME)),
        ("UploadForm", "refine", words::<Switch>()),
        ("UploadForm", "snap", words::<Switch>()),
        ("UploadForm", "stereo", words::<Stereo>()),
        ("UploadForm", "tile", json!("^(full|[0-9]+)$")),
        ("UploadForm", "visibility", json!(["private", "link"])),
        ("UploadForm", "view_box", json!("^[^,]+,[^,]+,[^,]+$")),
        ("ExportOrder", "format", exports.clone().chain(["webp", "mp4"]).collect()),
        ("ExportOrder", "shape", words::<ModelShape>()),
        ("ExportOrder", "textures", words::<ModelTextures>()),
        ("ExportOrder", "path", words::<Path>()),
        ("ExportOrder", "preset", json!(PRESET_NAME)),
        ("NamedPreset", "name", json!(PRESET_NAME)),
        ("NamedPreset", "kind", json!(["view", "film", "photo"])),
    ];
    for (schema, field, allowed) in fields {
        restrict(&mut document["components"]["schemas"][schema]["properties"][field], allowed);
    }
    for name in ["WebhookOrder", "WebhookPatch"] {
        let fields = &mut document["components"]["schemas"][name]["properties"];
        restrict(&mut fields["events"]["items"], EventType::ALL.map(EventType::name).into_iter().collect());
        fields["url"]["format"] = "uri".into();
    }
    let stills = PictureFormat::ALL.iter().map(value_name);
    let parameters = [
        ("view", "format", stills.chain(["mpo", "mp4"].map(str::to_owned)).collect()),
        ("view", "stereo", words::<StereoLayout>()),
        ("view", "quilt", json!("^[0-9]+x[0-9]+$")),
        ("view", "crop", json!("^[^,]+,[^,]+,[^,]+,[^,]+$")),
        ("view", "path", words::<Path>()),
        ("view", "preset", json!(PRESET_NAME)),
        ("export", "format", exports.collect()),
        ("export", "shape", words::<ModelShape>()),
        ("export", "textures", words::<ModelTextures>()),
        ("atlas", "region", json!("^[0-9]+,[0-9]+,[0-9]+,[0-9]+$")),
    ];
    for (route, name, allowed) in parameters {
        let all = document["paths"][format!("/v1/photos/{{id}}/{route}")]["get"]["parameters"].as_array_mut();
        if let Some(parameter) = all.into_iter().flatten().find(|parameter| parameter["name"] == name) {
            restrict(&mut parameter["schema"], allowed);
        }
    }
}

/// Writes the versions, motions and idle motions of a photo's settings.
fn settings(schemas: &mut Value) {
    // a fraction of the view box, not a position in it
    let mut motion = schemas["Offset"].clone();
    for axis in ["x", "y", "z"] {
        motion["properties"][axis]["minimum"] = 0.0.into();
    }
    let settings = &mut schemas["Settings"]["properties"];
    motion["description"] = settings["motion"]["oneOf"][0]["description"].take();
    settings["motion"]["oneOf"][0] = motion;
    settings["version"]["enum"] = [VERSION].into();
    let ways = idle_names().map(Value::from).chain([Value::Null]);
    settings["idle"]["enum"] = ways.collect();
}

/// Writes the longest lifetime of a link.
pub fn add_link_limit(document: &mut Value, most: u64) {
    let parameters = document["paths"]["/v1/photos/{id}/links"]["post"]["parameters"].as_array_mut();
    if let Some(seconds) = parameters.into_iter().flatten().find(|p| p["name"] == "seconds") {
        seconds["schema"]["maximum"] = most.into();
        seconds["description"] = format!("Lifetime, 1 to {most}; at most a day if it is not given").into();
    }
}
