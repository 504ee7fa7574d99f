//! Types of the container's schema, generated from `proto/tmpi.proto`.
#![allow(clippy::pedantic, missing_docs, reason = "generated code")]
include!(concat!(env!("OUT_DIR"), "/tmpi.v1.rs"));
