//! Words that fields and parameters may be, written into the `OpenAPI` document from where they are read: types of other crates describe
//! themselves to the command line alone.

use clap::ValueEnum;
use serde_json::Value;

use crate::export::ExportFormat;
use crate::server::options::chosen;
use tmpi_pipeline::depth::DepthKind;
use tmpi_pipeline::{Denoise, PlaneMethod, Switch};
use tmpi_render::{Path, PictureFormat};

/// All words of a choice.
fn words<T: ValueEnum>() -> Vec<String> {
    T::value_variants().iter().map(chosen).collect()
}

/// What a text may be.
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

/// What is read field by field, so that another field is an error.
const CLOSED: [&str; 6] = ["Offset", "Settings", "Stroke", "Strokes", "StrokesPatch", "UploadForm"];

/// Writes them into `document`, and which schemas have no other fields than theirs.
pub fn put(document: &mut Value) {
    for name in CLOSED {
        document["components"]["schemas"][name]["additionalProperties"] = false.into();
    }
    document["components"]["securitySchemes"] = serde_json::json!({
        "bearer": {"type": "http", "scheme": "bearer", "description": "An API key (`tmpi_k_…`, by `tmpi key add`), or an owner's own secret: \
            `tmpi_o_` and 32 to 128 letters, digits, - and _ chosen at random. Asked for with `tmpi serve --access private` alone"},
        "cookie": {"type": "apiKey", "in": "cookie", "name": "tmpi_owner", "description": "An owner's secret as a browser keeps it"},
    });
    // nothing is needed where the server asks nobody, and for what its owner lets everybody see
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
        ("tile", Text::Pattern("^(full|[0-9]+)$")),
        ("visibility", Text::Words(["private", "link"].map(str::to_owned).into())),
        ("view_box", Text::Pattern("^[^,]+,[^,]+,[^,]+$")),
    ] {
        text.put(&mut form[field]);
    }
    let stills = PictureFormat::ALL.map(|f| chosen(&f));
    let exports = [ExportFormat::Html, ExportFormat::Glb, ExportFormat::Ora, ExportFormat::Zip].map(|f| f.extension().to_owned());
    let order = &mut document["components"]["schemas"]["ExportOrder"]["properties"];
    Text::Words([&exports[..], &["webp".to_owned(), "mp4".to_owned()]].concat()).put(&mut order["format"]);
    Text::Words(["relief", "metric"].map(str::to_owned).into()).put(&mut order["shape"]);
    Text::Words(words::<Path>()).put(&mut order["path"]);
    for (path, parameter, text) in [
        ("/v1/photos/{id}/view", "format", Text::Words([&stills[..], &["mp4".to_owned()]].concat())),
        ("/v1/photos/{id}/view", "stereo", Text::Words(["sbs", "anaglyph"].map(str::to_owned).into())),
        ("/v1/photos/{id}/view", "quilt", Text::Pattern("^[0-9]+x[0-9]+$")),
        ("/v1/photos/{id}/view", "crop", Text::Pattern("^[^,]+,[^,]+,[^,]+,[^,]+$")),
        ("/v1/photos/{id}/view", "path", Text::Words(words::<Path>())),
        ("/v1/live/{room}/frames/{frame}/view", "format", Text::Words(stills.into())),
        ("/v1/live/{room}/frames/{frame}/view", "stereo", Text::Words(["sbs", "anaglyph"].map(str::to_owned).into())),
        ("/v1/live/{room}/frames/{frame}/view", "quilt", Text::Pattern("^[0-9]+x[0-9]+$")),
        ("/v1/live/{room}/frames/{frame}/view", "crop", Text::Pattern("^[^,]+,[^,]+,[^,]+,[^,]+$")),
        ("/v1/photos/{id}/export", "format", Text::Words(exports.into())),
        ("/v1/photos/{id}/export", "shape", Text::Words(["relief", "metric"].map(str::to_owned).into())),
        ("/v1/photos/{id}/atlas", "region", Text::Pattern("^[0-9]+,[0-9]+,[0-9]+,[0-9]+$")),
    ] {
        let parameters = document["paths"][path]["get"]["parameters"].as_array_mut();
        if let Some(found) = parameters.into_iter().flatten().find(|p| p["name"] == parameter) {
            text.put(&mut found["schema"]);
        }
    }
}

/// Writes how long a link may be good.
pub fn put_link(document: &mut Value, most: u64) {
    let parameters = document["paths"]["/v1/photos/{id}/links"]["post"]["parameters"].as_array_mut();
    if let Some(seconds) = parameters.into_iter().flatten().find(|p| p["name"] == "seconds") {
        seconds["schema"]["maximum"] = most.into();
        seconds["description"] = format!("How long it is good, 1 to {most}; a day, or that, if it is not given").into();
    }
}
