//! Writes the body of every error into the `OpenAPI` document, so that handlers give only status and reason.

use serde_json::{Value, json};

use crate::server::problem::MEDIA_TYPE;

/// Gives every answer of `document` with a status from 400 on a problem document (RFC 9457) as its body.
pub fn add_errors(document: &mut Value) {
    let content = json!({MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}});
    let paths = document["paths"].as_object_mut().into_iter().flat_map(|paths| paths.values_mut());
    let operations = paths.filter_map(Value::as_object_mut).flat_map(|path| path.values_mut());
    for answers in operations.filter_map(|operation| operation.get_mut("responses")?.as_object_mut()) {
        for (_, answer) in answers.iter_mut().filter(|(status, _)| status.as_str() >= "400") {
            answer["content"] = content.clone();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_errors_get_a_body() {
        let mut document = json!({"paths": {"/a": {"get": {"responses": {"204": {}, "304": {}, "400": {}, "503": {"description": "x"}}}}}});
        add_errors(&mut document);
        let answers = &document["paths"]["/a"]["get"]["responses"];
        assert!(answers["204"] == json!({}) && answers["304"] == json!({}));
        for status in ["400", "503"] {
            assert_eq!(answers[status]["content"]["application/problem+json"]["schema"]["$ref"], "#/components/schemas/Problem");
        }
        assert_eq!(answers["503"]["description"], "x");
    }
}
