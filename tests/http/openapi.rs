//! Checks the `OpenAPI` document against the server.

use tmpi::server::{BasePath, routes};

use crate::exports::written;
use crate::live::{Publisher, frame};
use crate::prelude::*;

/// A webhook at an address that does not exist.
const WEBHOOK: &[u8] = br#"{"url": "https://nowhere.invalid/"}"#;

#[test]
fn every_route_of_the_document_answers_as_it_says() {
    let server = Running::open();
    let document = get(server.addr, "/openapi.json").json();
    let photo = server.make(&jpeg(1));
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    wait_until("a group of pictures is complete", || {
        publisher.publish(frame(20));
        get(server.addr, "/v1/live/attic/gops/latest").header("location").is_some_and(|l| !l.ends_with("-0"))
    });
    wait_until("a frame is done", || get(server.addr, "/v1/live/attic/frames/latest/atlas").status == 200);
    let newest = get(server.addr, "/v1/live/attic/gops/latest");
    let first = format!("{}-0", newest.header("location").unwrap().split('-').next().unwrap());
    let webhook = id(&request(server.addr, "POST", "/v1/webhooks", &[JSON], WEBHOOK).json());
    let mut deletions = Vec::new();
    let mut count = 0;
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            // a new export for each call: a previous call may have deleted it or made the photo again
            let export = if path.contains("{key}") { written(server.addr, &photo, "format=glb") } else { Value::Null };
            let key = export["key"].as_str().unwrap_or_default();
            let path = if path == "/oembed" { "/oembed?url=http://localhost/view/{id}" } else { path };
            let id = if path.starts_with("/v1/webhooks") { &webhook } else { &photo };
            let path = path.replace("{id}", id).replace("{key}", key).replace("{room}", "attic").replace("{group}", &first);
            let call = (method.to_uppercase(), path, operation);
            if method == "delete" && key.is_empty() {
                deletions.push(call);
            } else {
                check(&server, &call);
                // the call may have started making the photo again
                server.wait(&photo, "done");
            }
            count += 1;
        }
    }
    // longest paths first: the photo itself last
    deletions.sort_by_key(|(_, path, _)| std::cmp::Reverse(path.len()));
    for call in deletions {
        check(&server, &call);
    }
    // undocumented routes are pages and their files
    let (documented, pages): (Vec<_>, Vec<_>) = routes().into_iter().partition(|r| document["paths"][&r.path].is_object());
    assert_eq!(count, documented.iter().map(|r| r.methods.len()).sum::<usize>());
    assert!(pages.iter().all(|r| !r.path.starts_with("/v1/") && r.methods == ["GET"]), "{pages:?}");
}

fn check(server: &Running, (method, path, operation): &(String, String, &Value)) {
    let (headers, body): (&[_], _) = match method.as_str() {
        "POST" if path == "/v1/photos" => (&[], jpeg(2)),
        "POST" if path == "/v1/webhooks" => (&[JSON], WEBHOOK.to_vec()),
        "PATCH" => (&[JSON], b"{}".to_vec()),
        _ => (&[], Vec::new()),
    };
    let answer = request(server.addr, method, path, headers, &body);
    // the caller has no owner's secret
    if path == "/v1/owner/ticket" {
        assert_eq!(answer.status, 403);
        return;
    }
    // live.rs opens sockets; here they answer 426
    let status = if operation["responses"]["101"].is_object() { 426..427 } else { 200..300 };
    assert!(status.contains(&answer.status), "{method} {path}: {}", answer.status);
    let described = &operation["responses"][answer.status.to_string()];
    assert!(described["description"].as_str().is_some_and(|d| !d.is_empty()), "{method} {path}: {} is not described", answer.status);
    if let Some(content) = described["content"].as_object() {
        let media_type = answer.header("content-type").unwrap().split(';').next().unwrap();
        assert!(content.contains_key(media_type), "{method} {path}: {media_type} is not described");
    }
    assert!(operation["operationId"].is_string() && operation["summary"].is_string());
}

#[test]
fn every_schema_and_parameter_is_described() {
    let document: Value = serde_json::from_slice(&tmpi::server::openapi().unwrap()).unwrap();
    assert!(document["openapi"].as_str().unwrap().starts_with("3."));
    let described = |v: &Value| v["description"].as_str().is_some_and(|d| !d.is_empty());
    let schemas = document["components"]["schemas"].as_object().unwrap();
    for name in ["Problem", "PhotoState", "PhotoList", "Report", "Progress", "Links", "UploadForm", "Settings"] {
        assert!(schemas.contains_key(name), "{name} is missing");
    }
    for (name, schema) in schemas {
        assert!(described(schema), "schema {name}");
        for (field, property) in schema["properties"].as_object().into_iter().flatten() {
            // a referenced schema has its own description
            assert!(described(property) || property["$ref"].is_string() || property["oneOf"].is_array(), "{name}.{field}");
        }
    }
    assert_eq!(document["servers"][0]["url"], "/");
    let security = document["security"].as_array().unwrap();
    assert!(security.contains(&serde_json::json!({})), "public routes need no credentials");
    let schemes = document["components"]["securitySchemes"].as_object().unwrap();
    let named: Vec<&String> = security.iter().flat_map(|s| s.as_object().unwrap().keys()).collect();
    assert!(named.len() == schemes.len() && named.iter().all(|name| described(&schemes[*name])), "{named:?}");
    assert!(!schemas["Settings"]["required"].as_array().is_some_and(|r| r.contains(&"version".into())), "a patch needs no version");
    let settings = &schemas["Settings"]["properties"];
    let of_motion = &settings["motion"]["oneOf"][0];
    let bounds = [&of_motion["properties"]["x"]["minimum"], &of_motion["properties"]["z"]["maximum"]];
    assert_eq!(bounds.map(Value::as_f64), [Some(0.0), Some(1.0)]);
    assert_eq!(schemas["Offset"]["properties"]["y"]["minimum"], -1.0);
    assert!(settings["idle"]["enum"].as_array().unwrap().contains(&"none".into()));
    assert!(settings["title"]["maxLength"] == 200 && settings["version"]["enum"] == serde_json::json!([1]));
    assert_eq!(document["paths"]["/v1/photos/{id}/exports"]["post"]["requestBody"]["required"], false);
    let with_door: Value =
        serde_json::from_slice(&tmpi::server::openapi_of(&Limits::default(), true, &BasePath::default()).unwrap()).unwrap();
    assert!(document["paths"]["/metrics"].is_object() && with_door["paths"]["/metrics"].is_null(), "admin routes are on their listener");
    let of_strokes = &schemas["StrokesPatch"];
    assert_eq!(of_strokes["required"], Value::Null);
    assert_eq!(of_strokes["properties"]["strokes"]["type"], json!(["array", "null"]));
    let mut ids = std::collections::HashSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            assert!(ids.insert(&operation["operationId"]), "{method} {path}: {}", operation["operationId"]);
            assert!(operation["responses"].as_object().unwrap().keys().any(|s| s.starts_with('4')), "{method} {path} refuses nothing");
            for parameter in operation["parameters"].as_array().into_iter().flatten() {
                assert!(described(parameter), "{method} {path}: {}", parameter["name"]);
            }
        }
    }
    // every reference resolves
    let text = document.to_string();
    for reference in text.split("\"$ref\":\"#/components/schemas/").skip(1) {
        let name = reference.split('"').next().unwrap();
        assert!(schemas.contains_key(name), "{name}");
    }
}

/// True if the answer refuses the value of this field.
fn is_refused(answer: &Response, field: &str) -> bool {
    answer.status == 400 && answer.json()["field"] == field
}

/// True if the value is not one of the field's choices; false if it is refused for another reason, such as a missing network.
fn is_no_word(answer: &Response, field: &str) -> bool {
    is_refused(answer, field) && answer.json()["detail"].as_str().unwrap().contains("must be one of")
}

#[test]
fn words_of_the_document_are_those_that_are_taken() {
    // the gate lets only the first photo through
    let server = Running::with(Limits::default(), Gate::new(1));
    let id = server.make(&jpeg(1));
    let document = get(server.addr, "/openapi.json").json();
    let fields = document["components"]["schemas"]["UploadForm"]["properties"].as_object().unwrap();
    let upload = |field: &str, value: &str| post_form(server.addr, &[], &[("photo", &jpeg(1)), (field, value.as_bytes())]);
    let unknown = upload("no-such-option", "1").problem(400)["detail"].as_str().unwrap().to_owned();
    let known = unknown.rsplit("there are ").next().unwrap();
    let mut described: Vec<&str> = fields.keys().map(String::as_str).collect();
    described.sort_unstable();
    let mut taken: Vec<String> = known.split(", ").map(|name| name.replace('-', "_")).collect();
    taken.sort_unstable();
    assert_eq!(described, taken, "the document has exactly the fields that the server takes");
    let schemas = document["components"]["schemas"].as_object().unwrap();
    let closed: Vec<&String> = schemas.iter().filter(|(_, s)| s["additionalProperties"] == false).map(|(name, _)| name).collect();
    assert_eq!(closed, ["Offset", "Settings", "Stroke", "Strokes", "StrokesPatch", "UploadForm", "WebhookOrder", "WebhookPatch"]);
    let json: &[(&str, &str)] = &[("content-type", "application/merge-patch+json")];
    for (path, body, field) in [
        ("", r#"{"halo": 1}"#, "halo"),
        ("", r#"{"start": {"x": 0, "halo": 1}}"#, "start.halo"),
        ("/strokes", r#"{"halo": 1}"#, "halo"),
        ("/strokes", r#"{"strokes": [{"points": [[0.5, 0.5]], "radius": 0.1, "to": 0, "halo": 1}]}"#, "strokes[0].halo"),
    ] {
        let answer = request(server.addr, "PATCH", &format!("/v1/photos/{id}{path}"), json, body.as_bytes());
        assert!(is_refused(&answer, field), "{body}: {}", answer.json());
    }
    let mut choices = 0;
    for (field, schema) in fields.iter().filter(|(name, schema)| !matches!(name.as_str(), "photo" | "depth") && schema["type"] == "string")
    {
        assert!(is_refused(&upload(field, "nonsense"), &field.replace('_', "-")), "{field}");
        for word in schema["enum"].as_array().into_iter().flatten() {
            assert!(!is_no_word(&upload(field, word.as_str().unwrap()), &field.replace('_', "-")), "{field}: {word}");
            choices += 1;
        }
        assert!(schema["enum"].is_array() || schema["pattern"].is_string(), "{field}: any text");
    }
    assert!(choices > 10, "{choices}");
    for part in ["view", "export"] {
        let parameters = document["paths"][format!("/v1/photos/{{id}}/{part}")]["get"]["parameters"].as_array().unwrap();
        // `v` takes any text
        for parameter in parameters.iter().filter(|p| p["in"] == "query" && p["schema"]["type"] == "string" && p["name"] != "v") {
            let name = parameter["name"].as_str().unwrap();
            let ask = |value: &str| {
                let film = match value {
                    "mp4" => "path=orbit&",
                    "mpo" => "stereo=sbs&",
                    _ => "",
                };
                let frames = if name == "path" || value == "mp4" { "frames=2&" } else { "" };
                let rest = if part == "view" { "w=8&" } else { "" };
                let model = if matches!(name, "shape" | "textures") { "format=glb&" } else { "" };
                get(server.addr, &format!("/v1/photos/{id}/{part}?{rest}{model}{film}{frames}{name}={value}"))
            };
            assert!(is_refused(&ask("nonsense"), name), "{part} {name}");
            for word in parameter["schema"]["enum"].as_array().into_iter().flatten() {
                let answer = ask(word.as_str().unwrap());
                // films answer 501 without ffmpeg
                assert!(matches!(answer.status, 200 | 501), "{part} {name}={word}: {}", answer.status);
                choices += 1;
            }
            assert!(parameter["schema"]["enum"].is_array() || parameter["schema"]["pattern"].is_string(), "{part} {name}: any text");
        }
    }
    assert!(choices > 20, "{choices}");
}
