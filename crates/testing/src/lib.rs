//! What tests need of the machine: where it is missing a test says so and passes, unless `TMPI_REQUIRE` names it.

#[allow(clippy::expect_used, reason = "an engine that is installed and does not start fails the test")]
pub mod engines;
pub mod jpeg;
pub mod png;

use std::fmt::Display;

pub use engines::Engine;

/// Environment variable: what must be there, by the names of [`Need`], separated by commas.
pub const VARIABLE: &str = "TMPI_REQUIRE";

/// What a test may be skipped without.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// `gpu`: a graphics adapter, one in software included.
    Gpu,
    /// `onnx`: the ONNX Runtime library.
    Onnx,
    /// `ffmpeg`: the program.
    Ffmpeg,
    /// `nats`: the program `nats-server`.
    Nats,
    /// `s3`: moto, an S3 server in Python.
    S3,
    /// `azure`: azurite, an Azure server in JavaScript.
    Azure,
}

impl Need {
    const ALL: [Self; 6] = [Self::Gpu, Self::Onnx, Self::Ffmpeg, Self::Nats, Self::S3, Self::Azure];

    const fn name(self) -> &'static str {
        match self {
            Self::Gpu => "gpu",
            Self::Onnx => "onnx",
            Self::Ffmpeg => "ffmpeg",
            Self::Nats => "nats",
            Self::S3 => "s3",
            Self::Azure => "azure",
        }
    }

    /// What was found of it; none, said aloud, where it is missing and the test is to be skipped.
    ///
    /// # Panics
    /// It is missing and `TMPI_REQUIRE` names it, or `TMPI_REQUIRE` names what there is no word for.
    #[must_use]
    pub fn or_skip<T, E: Display>(self, found: Result<T, E>) -> Option<T> {
        let required = std::env::var(VARIABLE).unwrap_or_default();
        match self.judged(&required, found) {
            Ok(found) => found,
            Err(failure) => panic!("{failure}"),
        }
    }

    /// The same by the value of the variable; the error is what the test fails with.
    fn judged<T, E: Display>(self, required: &str, found: Result<T, E>) -> Result<Option<T>, String> {
        let words = || required.split(',').map(str::trim).filter(|w| !w.is_empty());
        if let Some(word) = words().find(|w| Self::ALL.iter().all(|n| n.name() != *w)) {
            return Err(format!("{VARIABLE} knows no {word:?}; it knows {}", Self::ALL.map(Self::name).join(", ")));
        }
        match found {
            Ok(found) => Ok(Some(found)),
            Err(reason) if words().any(|w| w == self.name()) => Err(format!("{VARIABLE} names {}: {reason}", self.name())),
            Err(reason) => {
                eprintln!("skipped, no {}: {reason}", self.name());
                Ok(None)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_skips_a_test_unless_it_is_required() {
        let missing = || Err::<(), _>("not here");
        assert_eq!(Need::Gpu.judged("", missing()), Ok(None));
        assert_eq!(Need::Gpu.judged("onnx, ffmpeg", missing()), Ok(None));
        assert_eq!(Need::Gpu.judged("onnx, gpu", missing()), Err("TMPI_REQUIRE names gpu: not here".into()));
        assert_eq!(Need::Onnx.judged("onnx", Ok::<_, &str>(7)), Ok(Some(7)));
    }

    #[test]
    fn an_unknown_word_fails_even_where_everything_is_there() {
        let error = Need::Onnx.judged("gpu,onxx", Ok::<_, &str>(7)).unwrap_err();
        assert!(error.contains("\"onxx\"") && error.contains("gpu, onnx, ffmpeg, nats, s3, azure"), "{error}");
    }
}
