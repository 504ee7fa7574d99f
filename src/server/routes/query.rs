//! Extractors, and strict query parsing: on every route, parameters are known and given once.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;

use axum::body::HttpBody as _;
use axum::extract::{FromRequest, FromRequestParts, Query, Request};
use axum::http::Uri;
use axum::http::request::Parts;
use clap::ValueEnum;

use crate::server::photo_options::value_name;
use crate::server::problem::Problem;
use crate::server::request_body;

/// All parameters of a query, decoded.
pub fn decode(uri: &Uri) -> Result<Vec<(String, String)>, Problem> {
    Query::try_from_uri(uri).map(|Query(pairs)| pairs).map_err(|e| Problem::bad_request(e.body_text()))
}

/// Parameters of a query, decoded, known and given once.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Pairs(BTreeMap<String, String>);

impl Pairs {
    /// Reads a query with parameters from `names`.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown or given twice.
    pub fn read(uri: &Uri, names: &[&str]) -> Result<Self, Problem> {
        Self::of(decode(uri)?, names)
    }

    /// Like [`Pairs::read`], for parameters that are parsed already.
    pub fn of(pairs: Vec<(String, String)>, names: &[&str]) -> Result<Self, Problem> {
        let mut given = BTreeMap::new();
        for (name, value) in pairs {
            if !names.contains(&name.as_str()) {
                let known = if names.is_empty() { "none".into() } else { names.join(", ") };
                return Err(Problem::parameter(name, format!("there is no such parameter; there are {known}")));
            }
            if given.insert(name.clone(), value).is_some() {
                return Err(Problem::parameter(name, "is given twice"));
            }
        }
        Ok(Self(given))
    }

    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    pub fn take(&mut self, name: &str) -> Option<String> {
        self.0.remove(name)
    }

    /// The value of a parameter as `parse` reads it; `allowed` describes what it must be.
    pub fn parse<T>(&self, name: &str, allowed: &str, parse: impl FnOnce(&str) -> Option<T>) -> Result<Option<T>, Problem> {
        let wrong = |text: &str| Problem::parameter(name, format!("must be {allowed}, not {text:?}"));
        self.get(name).map(|text| parse(text).ok_or_else(|| wrong(text))).transpose()
    }

    pub fn choice<T: ValueEnum>(&self, name: &str) -> Result<Option<T>, Problem> {
        let all: Vec<String> = T::value_variants().iter().map(value_name).collect();
        self.parse(name, &format!("one of {}", all.join(", ")), |text| T::from_str(text, false).ok())
    }

    pub fn number<T: FromStr + PartialOrd + Display>(&self, name: &str, range: &RangeInclusive<T>) -> Result<Option<T>, Problem> {
        let allowed = format!("from {} to {}", range.start(), range.end());
        self.parse(name, &allowed, |text| text.parse().ok().filter(|number| range.contains(number)))
    }

    /// A parameter with a parser that says what is wrong.
    pub fn typed<T: FromStr<Err: Display>>(&self, name: &str) -> Result<Option<T>, Problem> {
        self.get(name).map(str::parse).transpose().map_err(|error| Problem::parameter(name, error))
    }
}

/// Extractor of routes without parameters.
pub struct NoQuery;

impl<S: Sync> FromRequestParts<S> for NoQuery {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Pairs::read(&parts.uri, &[]).map(|_| Self)
    }
}

/// Extractor of routes without a body. It refuses one, rather than ignore it silently.
pub struct EmptyBody;

impl<S: Sync> FromRequest<S> for EmptyBody {
    type Rejection = Problem;

    async fn from_request(request: Request, _: &S) -> Result<Self, Problem> {
        let refused = || Problem::bad_request("this route takes no body; parameters go in the query");
        let mut body = request.into_body();
        if body.size_hint().lower() > 0 {
            return Err(refused());
        }
        // an empty chunked body counts as none
        while let Some(frame) = http_body_util::BodyExt::frame(&mut body).await {
            if frame.map_err(|e| request_body::problem(&e))?.data_ref().is_some_and(|data| !data.is_empty()) {
                return Err(refused());
            }
        }
        Ok(Self)
    }
}

/// The version `v` in the query of a result, for routes without other parameters.
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
