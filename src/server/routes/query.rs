//! Queries: every name is known and given once, on every route.

use std::collections::BTreeMap;

use axum::body::HttpBody as _;
use axum::extract::{FromRequest, FromRequestParts, Query, Request};
use axum::http::Uri;
use axum::http::request::Parts;

use crate::server::body;
use crate::server::problem::Problem;

/// Parameters of a query, decoded.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Pairs(BTreeMap<String, String>);

impl Pairs {
    /// Reads a query of which the parameters are among `names`.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown or given twice.
    pub fn read(uri: &Uri, names: &[&str]) -> Result<Self, Problem> {
        Self::reading(uri, names, true)
    }

    /// The same where parameters of other names are somebody else's, and ignored.
    ///
    /// # Errors
    /// 400 that names the first parameter that is given twice.
    pub fn read_some(uri: &Uri, names: &[&str]) -> Result<Self, Problem> {
        Self::reading(uri, names, false)
    }

    fn reading(uri: &Uri, names: &[&str], strict: bool) -> Result<Self, Problem> {
        let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri).map_err(|e| Problem::bad_request(e.body_text()))?;
        Self::among(pairs, names, strict)
    }

    /// The same of parameters that came in another way.
    ///
    /// # Errors
    /// As [`Pairs::read`].
    pub fn of(pairs: Vec<(String, String)>, names: &[&str]) -> Result<Self, Problem> {
        Self::among(pairs, names, true)
    }

    fn among(pairs: Vec<(String, String)>, names: &[&str], strict: bool) -> Result<Self, Problem> {
        let mut given = BTreeMap::new();
        for (name, value) in pairs {
            if !names.contains(&name.as_str()) {
                if !strict {
                    continue;
                }
                let known = if names.is_empty() { "none here".into() } else { names.join(", ") };
                return Err(Problem::parameter(name, format!("there is no such parameter; there are {known}")));
            }
            if given.insert(name.clone(), value).is_some() {
                return Err(Problem::parameter(name, "is given twice"));
            }
        }
        Ok(Self(given))
    }

    /// The value of a parameter.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    /// Takes the value of a parameter.
    pub fn take(&mut self, name: &str) -> Option<String> {
        self.0.remove(name)
    }
}

/// A route that has no parameters.
pub struct NoQuery;

impl<S: Sync> FromRequestParts<S> for NoQuery {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Pairs::read(&parts.uri, &[]).map(|_| Self)
    }
}

/// A request without a body: what its client put there would have no effect, and nobody would say so.
pub struct NoBody;

impl<S: Sync> FromRequest<S> for NoBody {
    type Rejection = Problem;

    async fn from_request(request: Request, _: &S) -> Result<Self, Problem> {
        let refused = || Problem::bad_request("there is no body here; parameters go in the query");
        let mut body = request.into_body();
        if body.size_hint().lower() > 0 {
            return Err(refused());
        }
        // chunks of which the first is the last are none
        while let Some(frame) = http_body_util::BodyExt::frame(&mut body).await {
            if frame.map_err(|e| body::problem(&e))?.data_ref().is_some_and(|data| !data.is_empty()) {
                return Err(refused());
            }
        }
        Ok(Self)
    }
}

/// The version that a results' query asks for, where it has no other parameter.
pub struct OnlyVersion(pub Option<String>);

impl<S: Sync> FromRequestParts<S> for OnlyVersion {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Pairs::read(&parts.uri, &["v"]).map(|mut pairs| Self(pairs.take("v")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_decoded_known_and_given_once() {
        let read = |query: &str| Pairs::read(&format!("/x?{query}").parse().unwrap(), &["level", "v"]);
        assert_eq!(read("lev%65l=9&v=a%2Cb").unwrap().get("level"), Some("9"));
        assert_eq!(read("v=a%2Cb").unwrap().get("v"), Some("a,b"));
        assert_eq!(read("").unwrap(), Pairs::default());
        for (query, field) in [("zz=1", "zz"), ("level=1&lev%65l=2", "level"), ("level", "level"), ("=1", "")] {
            match read(query) {
                Err(p) => assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}"),
                Ok(pairs) => assert_eq!(pairs.get("level"), Some(""), "{query}"),
            }
        }
    }
}
