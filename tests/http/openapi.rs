//! The `OpenAPI` document against the server that it describes.

use std::sync::Arc;

use serde_json::Value;
use tmpi::server::Limits;

use crate::client::{get, request};
use crate::fixture::{Running, jpeg, pipeline};

fn start() -> (tempfile::TempDir, Running) {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits::default(), Arc::new(pipeline()));
    (dir, server)
}

#[test]
fn every_route_of_the_document_answers_as_it_says() {
    let (_dir, server) = start();
    let document = get(server.addr, "/openapi.json").json();
    let photo = server.upload(&jpeg(1));
    server.wait(&photo, "done");
    let mut deletions = Vec::new();
    let mut count = 0;
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            let path = if path == "/oembed" { "/oembed?url=http://localhost/view/{id}" } else { path };
            let call = (method.to_uppercase(), path.replace("{id}", &photo), operation);
            if method == "delete" {
                deletions.push(call);
            } else {
                check(&server, &call);
            }
            count += 1;
        }
    }
    for call in deletions {
        check(&server, &call);
    }
    assert_eq!(count, 18, "a route without a place in the document, or a new one");
}

fn check(server: &Running, (method, path, operation): &(String, String, &Value)) {
    let (headers, body): (&[_], _) = match method.as_str() {
        "POST" => (&[], jpeg(2)),
        "PATCH" => (&[("content-type", "application/json")], b"{}".to_vec()),
        _ => (&[], Vec::new()),
    };
    let answer = request(server.addr, method, path, headers, &body);
    assert!((200..300).contains(&answer.status), "{method} {path}: {}", answer.status);
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
            // a property that is another schema is described there
            assert!(described(property) || property["$ref"].is_string() || property["oneOf"].is_array(), "{name}.{field}");
        }
    }
    assert_eq!((&document["servers"][0]["url"], document["security"].as_array().map(Vec::len)), (&"/".into(), Some(1)));
    assert!(!schemas["Settings"]["required"].as_array().is_some_and(|r| r.contains(&"version".into())), "a patch needs no version");
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            assert!(operation["responses"].as_object().unwrap().keys().any(|s| s.starts_with('4')), "{method} {path} refuses nothing");
            for parameter in operation["parameters"].as_array().into_iter().flatten() {
                assert!(described(parameter), "{method} {path}: {}", parameter["name"]);
            }
        }
    }
    // every reference leads somewhere
    let text = document.to_string();
    for reference in text.split("\"$ref\":\"#/components/schemas/").skip(1) {
        let name = reference.split('"').next().unwrap();
        assert!(schemas.contains_key(name), "{name}");
    }
}
