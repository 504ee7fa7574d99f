//! Answers that are derived from a photo on request: views, films and exports.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderName};
use axum::response::Response;

use crate::server::app_state::{AppState, StoredFile};
use crate::server::conditional::{ContentCoding, Entity, cache_control_for, insert, known_etag, not_modified, respond};
use crate::server::finished_photo::FinishedPhoto;
use crate::server::program_digest;

/// A derived answer before it is made.
pub(super) struct Derived {
    /// Its name, a hash of everything that it depends on.
    pub made: String,
    cache_control: &'static str,
}

impl Derived {
    /// For a finished photo. `asked` is the version in the query; `name` maps the photo's version to everything that the answer depends on.
    pub fn new(app: &AppState, done: &FinishedPhoto, asked: Option<&str>, name: impl FnOnce(&str) -> String) -> Self {
        let results = app.version(done);
        Self { cache_control: cache_control_for(asked, || results.clone()), made: program_digest::short(&name(&results)) }
    }

    /// 304 for a client that has the answer already.
    pub fn known(&self, headers: &HeaderMap) -> Option<Response> {
        known_etag(headers, &self.made).map(|etag| not_modified(etag, self.cache_control))
    }

    /// The answer, with the time of each phase if it was made for this request.
    pub fn answer(&self, headers: &HeaderMap, stored: StoredFile, content_type: &str, timing: &[(&str, Duration)]) -> Response {
        let entity = Entity {
            source: stored.source,
            etag: &stored.etag,
            content_type,
            cache_control: self.cache_control,
            coding: ContentCoding::Plain,
        };
        let mut response = respond(headers, entity);
        if !timing.is_empty() {
            let all: Vec<String> = timing.iter().map(|(name, d)| format!("{name};dur={:.2}", d.as_secs_f64() * 1e3)).collect();
            insert(&mut response, HeaderName::from_static("server-timing"), &all.join(", "));
        }
        response
    }
}
