//! Writes the allowed values of fields and parameters into the `OpenAPI` document, from the types that parse them: types of other crates
//! have no `utoipa` schemas.

use clap::ValueEnum;
use serde_json::Value;

use crate::export::{ExportFormat, ModelShape, ModelTextures};
use crate::server::photo_options::value_name;
use crate::server::viewer_settings::{Idle, SPEED, TITLE, VERSION};
use tmpi_library::EventType;
use tmpi_pipeline::depth::DepthKind;
use tmpi_pipeline::{Denoise, PlaneMethod, Stereo, Switch};
use tmpi_render::{Path, PictureFormat, StereoLayout};

/// All values of a choice.
fn words<T: ValueEnum>() -> Vec<String> {
    T::value_variants().iter().map(value_name).collect()
}

/// Allowed values of a string.
enum Text {
    Words(Vec<String>),
    Pattern(&'static str),
}

impl Text {
    fn put(self, schema: &mut Value) {
        match self {
            Self::Words(words) => schema["enum"] = words.into(),
            Self::Pattern(pattern) => schema["pattern"] = pattern.into(),
        }
        schema["type"] = "string".into();
    }
}

/// Schemas whose parsers refuse unknown fields.
const CLOSED: [&str; 8] = ["Offset", "Settings", "Stroke", "Strokes", "StrokesPatch", "UploadForm", "WebhookOrder", "WebhookPatch"];

/// Writes allowed values, closed schemas and security schemes into `document`.
pub fn add_values(document: &mut Value) {
    for name in CLOSED {
        document["components"]["schemas"][name]["additionalProperties"] = false.into();
    }
    document["components"]["securitySchemes"] = serde_json::json!({
        "bearer": {"type": "http", "scheme": "bearer", "description": "An API key (`tmpi_k_…`, from `tmpi key add`), an owner's own secret \
            (`tmpi_o_` and 32 to 128 random letters, digits, - and _), or a photo's own token (`tmpi_m_…`, from `manage` in links). Only \
            with `tmpi serve --access private`"},
        "cookie": {"type": "apiKey", "in": "cookie", "name": "tmpi_owner", "description": "An owner's secret or session in a browser"},
    });
    settings(&mut document["components"]["schemas"]);
    // the query may hold the parameters of a file
    document["paths"]["/v1/photos/{id}/exports"]["post"]["requestBody"]["required"] = false.into();
    // no credentials are needed with open access, and for photos that their owner shows to everyone
    document["security"] = serde_json::json!([{}, {"bearer": []}, {"cookie": []}]);
    let form = &mut document["components"]["schemas"]["UploadForm"]["properties"];
    for (field, text) in [
        ("class", Text::Words(["interactive", "batch"].map(str::to_owned).into())),
        ("denoise", Text::Words(words::<Denoise>())),
        ("depth_kind", Text::Words(words::<DepthKind>())),
        ("photo_depth", Text::Words(words::<Switch>())),
        ("plane_method", Text::Words(words::<PlaneMethod>())),
        ("planes", Text::Pattern("^(auto|[0-9]+)$")),
        ("refine", Text::Words(words::<Switch>())),
        ("snap", Text::Words(words::<Switch>())),
        ("stereo", Text::Words(words::<Stereo>())),
        ("tile", Text::Pattern("^(full|[0-9]+)$")),
        ("visibility", Text::Words(["private", "link"].map(str::to_owned).into())),
        ("view_box", Text::Pattern("^[^,]+,[^,]+,[^,]+$")),
    ] {
        text.put(&mut form[field]);
    }
    for name in ["WebhookOrder", "WebhookPatch"] {
        let fields = &mut document["components"]["schemas"][name]["properties"];
        Text::Words(EventType::ALL.map(|event| event.name().to_owned()).into()).put(&mut fields["events"]["items"]);
        fields["url"]["format"] = "uri".into();
    }
    let stills = PictureFormat::ALL.map(|f| value_name(&f));
    let exports = ExportFormat::ALL.map(|f| f.extension().to_owned());
    let order = &mut document["components"]["schemas"]["ExportOrder"]["properties"];
    Text::Words([&exports[..], &["webp".to_owned(), "mp4".to_owned()]].concat()).put(&mut order["format"]);
    Text::Words(words::<ModelShape>()).put(&mut order["shape"]);
    Text::Words(words::<ModelTextures>()).put(&mut order["textures"]);
    Text::Words(words::<Path>()).put(&mut order["path"]);
    for (path, parameter, text) in [
        ("/v1/photos/{id}/view", "format", Text::Words([&stills[..], &["mpo", "mp4"].map(str::to_owned)].concat())),
        ("/v1/photos/{id}/view", "stereo", Text::Words(words::<StereoLayout>())),
        ("/v1/photos/{id}/view", "quilt", Text::Pattern("^[0-9]+x[0-9]+$")),
        ("/v1/photos/{id}/view", "crop", Text::Pattern("^[^,]+,[^,]+,[^,]+,[^,]+$")),
        ("/v1/photos/{id}/view", "path", Text::Words(words::<Path>())),
        ("/v1/photos/{id}/export", "format", Text::Words(exports.into())),
        ("/v1/photos/{id}/export", "shape", Text::Words(words::<ModelShape>())),
        ("/v1/photos/{id}/export", "textures", Text::Words(words::<ModelTextures>())),
        ("/v1/photos/{id}/atlas", "region", Text::Pattern("^[0-9]+,[0-9]+,[0-9]+,[0-9]+$")),
    ] {
        let parameters = document["paths"][path]["get"]["parameters"].as_array_mut();
        if let Some(found) = parameters.into_iter().flatten().find(|p| p["name"] == parameter) {
            text.put(&mut found["schema"]);
        }
    }
}

/// Writes the bounds of a photo's settings.
fn settings(schemas: &mut Value) {
    let bounded = |least: f64| {
        let mut offset = schemas["Offset"].clone();
        for axis in ["x", "y", "z"] {
            (offset["properties"][axis]["minimum"], offset["properties"][axis]["maximum"]) = (least.into(), 1.0.into());
        }
        offset
    };
    let (reach, place) = (bounded(0.0), bounded(-1.0));
    schemas["Offset"] = place;
    let settings = &mut schemas["Settings"]["properties"];
    // a fraction of the view box, not a position in it
    let mut motion = reach;
    motion["description"] = settings["motion"]["oneOf"][0]["description"].take();
    settings["motion"]["oneOf"][0] = motion;
    settings["version"]["enum"] = [VERSION].into();
    (settings["focus"]["minimum"], settings["focus"]["maximum"]) = (0.into(), 1.into());
    (settings["speed"]["minimum"], settings["speed"]["maximum"]) = (SPEED[0].into(), SPEED[1].into());
    (settings["title"]["minLength"], settings["title"]["maxLength"]) = (1.into(), TITLE.into());
    let printed = r"[^\u0000-\u001f\u007f-\u009f]*";
    settings["title"]["pattern"] = format!(r"^{printed}[^\s\u0000-\u001f\u007f-\u009f]{printed}$").into();
    let ways = Idle::names().map(Value::from).chain([Value::Null]);
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
