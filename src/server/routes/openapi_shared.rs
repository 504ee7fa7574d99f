//! Writes what many routes share into the `OpenAPI` document, so that handlers describe only what is their own.

use serde_json::{Value, json};

use crate::server::problem::MEDIA_TYPE;

/// Errors of routes whose paths start alike, unless a route describes the status itself; the first one counts.
const ERRORS: [[&str; 3]; 8] = [
    ["/v1/live/{room}", "400", "A parameter is unknown"],
    ["/v1/live/{room}", "403", "No valid token: a page of another site always needs one"],
    ["/v1/live/{room}", "404", "The name is invalid, or rooms are disabled"],
    ["/v1/photos/{id}/exports/{key}", "404", "There is no such file"],
    ["/", "400", "A parameter is unknown or given twice, or there is a body that the route does not take"],
    ["/v1/photos/{id}", "404", "There is no such photo"],
    ["/v1/webhooks", "403", "The caller is no owner"],
    ["/v1/webhooks/{id}", "404", "There is no such webhook"],
];
/// Parameters in paths that start alike.
const PARAMETERS: [[&str; 3]; 3] = [
    ["/v1/photos/{id}", "id", "Id of the photo"],
    ["/v1/photos/{id}/exports/{key}", "key", "Name of the file"],
    ["/v1/webhooks/{id}", "id", "Id of the webhook"],
];

/// Adds shared parameters and errors to `document`. Every answer with a status from 400 on is a problem document (RFC 9457).
pub fn add_shared(document: &mut Value) {
    let problem = json!({MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}});
    for (path, item) in document["paths"].as_object_mut().into_iter().flatten() {
        let shared = |all: &'static [[&'static str; 3]]| all.iter().filter(move |[start, ..]| path.starts_with(start));
        let operations = item.as_object_mut().into_iter().flat_map(|item| item.values_mut());
        for operation in operations.filter(|operation| operation["responses"].is_object()) {
            let in_path = shared(&PARAMETERS).map(|[_, name, about]| {
                json!({"name": name, "in": "path", "description": about, "required": true, "schema": {"type": "string"}})
            });
            let mut parameters: Vec<Value> = in_path.collect();
            if !parameters.is_empty() {
                let own = operation["parameters"].as_array().into_iter().flatten();
                parameters.extend(own.filter(|parameter| parameter["in"] != "path").cloned());
                operation["parameters"] = parameters.into();
            }
            let answers = &mut operation["responses"];
            for [_, status, about] in shared(&ERRORS) {
                if answers[status].is_null() {
                    answers[status] = json!({"description": about});
                }
            }
            for (_, answer) in answers.as_object_mut().into_iter().flatten().filter(|(status, _)| status.as_str() >= "400") {
                answer["content"] = problem.clone();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_errors_get_a_body() {
        let mut document = json!({"paths": {"/a": {"get": {"responses": {"204": {}, "304": {}, "503": {"description": "x"}}}}}});
        add_shared(&mut document);
        let answers = &document["paths"]["/a"]["get"]["responses"];
        assert!(answers["204"] == json!({}) && answers["304"] == json!({}));
        for status in ["400", "503"] {
            assert_eq!(answers[status]["content"]["application/problem+json"]["schema"]["$ref"], "#/components/schemas/Problem");
        }
        assert_eq!(answers["503"]["description"], "x");
    }

    #[test]
    fn a_route_has_the_shared_parameters_first_and_keeps_its_own_errors() {
        let own = json!({"parameters": [{"name": "v", "in": "query"}], "responses": {"404": {"description": "There is no such file"}}});
        let path = "/v1/photos/{id}/exports/{key}";
        let mut document = json!({"paths": {path: {"get": own}}});
        add_shared(&mut document);
        let route = &document["paths"][path]["get"];
        let names: Vec<&Value> = route["parameters"].as_array().unwrap().iter().map(|parameter| &parameter["name"]).collect();
        assert_eq!(names, ["id", "key", "v"]);
        assert_eq!(route["responses"]["404"]["description"], "There is no such file");
        assert!(route["responses"]["400"]["description"].is_string());
    }
}
