//! Message types, generated from `proto/live.proto`.
#![allow(clippy::pedantic, missing_docs, reason = "generated code")]
include!(concat!(env!("OUT_DIR"), "/tmpi.live.v1.rs"));
