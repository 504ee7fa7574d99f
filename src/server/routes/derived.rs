//! Answers that are made of a photo when they are asked for: views, films and exports.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderName};
use axum::response::Response;

use crate::server::app::{Shared, Stored};
use crate::server::conditional::{Coding, Entity, insert, kept, known_as, not_modified, respond};
use crate::server::identity;
use crate::server::made::Done;

/// Such an answer before it is made.
pub(super) struct Derived {
    /// Its name: that of all it follows from.
    pub made: String,
    cache_control: &'static str,
}

impl Derived {
    /// Of a finished photo; `asked`: the version in the query, `name`: what the answer follows from, by the photo's version.
    pub fn new(app: &Shared, done: &Done, asked: Option<&str>, name: impl FnOnce(&str) -> String) -> Self {
        let results = app.version(done);
        Self { cache_control: kept(asked, || results.clone()), made: identity::short(&name(&results)) }
    }

    /// The answer to a client that has it already.
    pub fn known(&self, headers: &HeaderMap) -> Option<Response> {
        known_as(headers, &self.made).map(|etag| not_modified(etag, self.cache_control))
    }

    /// The answer, with what each phase of making it took, if it was made for this request.
    pub fn answer(&self, headers: &HeaderMap, stored: Stored, content_type: &str, timing: &[(&str, Duration)]) -> Response {
        let entity =
            Entity { source: stored.source, etag: &stored.etag, content_type, cache_control: self.cache_control, coding: Coding::Plain };
        let mut response = respond(headers, entity);
        if !timing.is_empty() {
            let all: Vec<String> = timing.iter().map(|(name, d)| format!("{name};dur={:.2}", d.as_secs_f64() * 1e3)).collect();
            insert(&mut response, HeaderName::from_static("server-timing"), &all.join(", "));
        }
        response
    }
}
