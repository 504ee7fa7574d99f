//! Webhooks of the configuration, which are told of all photos and rooms.

use std::str::FromStr;

use serde::Deserialize;
use tmpi_library::{EventType, NewWebhook};

use super::SigningSecret;
use crate::server::outbound::{self, AddressPolicy};

/// A webhook of the configuration. It may have any address.
#[derive(Clone, Debug)]
pub struct ConfiguredWebhook(pub(in crate::server) NewWebhook);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    url: String,
    secret: String,
    #[serde(default)]
    events: Vec<String>,
}

impl FromStr for ConfiguredWebhook {
    type Err = String;

    /// Reads a JSON object of `url`, `secret` and `events`.
    fn from_str(text: &str) -> Result<Self, String> {
        let Fields { url, secret, events: names } = serde_json::from_str(text)
            // the error of another text would repeat the secret
            .map_err(|error| {
                format!("an object of url, secret and events is expected: line {}, column {}", error.line(), error.column())
            })?;
        outbound::url(&url, AddressPolicy::Any).map_err(|error| format!("url: {error}"))?;
        SigningSecret::parse(&secret).map_err(|error| format!("secret: {error}"))?;
        Ok(Self(NewWebhook { url, secret, events: event_types(&names).map_err(|error| format!("events: {error}"))? }))
    }
}

/// Reads the names of events; none stands for all.
///
/// # Errors
/// What is wrong with them.
pub fn event_types<S: AsRef<str>>(names: &[S]) -> Result<Vec<EventType>, String> {
    let known = || EventType::ALL.map(EventType::name).join(", ");
    let one = |name: &S| EventType::of_name(name.as_ref()).ok_or_else(|| format!("must be of {}, not {:?}", known(), name.as_ref()));
    let mut all: Vec<EventType> = names.iter().map(one).collect::<Result<_, _>>()?;
    all.sort_unstable();
    all.dedup();
    Ok(if all.is_empty() { EventType::ALL.to_vec() } else { all })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_webhook_of_the_configuration_is_checked() {
        let secret = format!("whsec_{}", "A".repeat(32));
        let read = |text: &str| text.replace("SECRET", &secret).parse::<ConfiguredWebhook>();
        let one = read(r#"{"url": "http://127.0.0.1:9/x", "secret": "SECRET", "events": ["photo.done", "photo.done"]}"#).unwrap();
        assert_eq!((one.0.url.as_str(), one.0.events.len()), ("http://127.0.0.1:9/x", 1));
        assert!(!format!("{one:?}").contains("AAAA"));
        assert_eq!(read(r#"{"url": "http://a", "secret": "SECRET"}"#).unwrap().0.events.len(), 7);
        for (wrong, word) in [
            (r#"{"url": "ftp://a", "secret": "SECRET"}"#, "url"),
            (r#"{"url": "http://a", "secret": "SECRE"}"#, "secret"),
            (r#"{"url": "http://a", "secret": "SECRET", "events": ["ping"]}"#, "events"),
            (r#"{"url": "http://a"}"#, "expected"),
            (r#"{"url": "http://a", "secret": "SECRET", "more": 1}"#, "expected"),
            ("[]", "expected"),
        ] {
            let error = read(wrong).unwrap_err();
            assert!(error.contains(word) && !error.contains("AAAA"), "{wrong}: {error}");
        }
    }
}
