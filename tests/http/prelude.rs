//! What most tests use.

pub use std::net::SocketAddr;
pub use std::path::Path;
pub use std::sync::Arc;
pub use std::sync::atomic::Ordering;
pub use std::time::{Duration, Instant};

pub use serde_json::{Value, json};
pub use tmpi::server::{Config, Fault, Limits, Maker, Product};
pub use tmpi_pipeline::{MakeError, Options, Sink};
pub use tmpi_render::{PictureFormat, View, encode};

pub use crate::access::{HOST, ask, private, private_with, secret, upload};
pub use crate::client::{Connection, JSON, Response, form, get, post_form, request, send_raw};
pub use crate::fixture::{
    Running, block_on, contents, depth_map, drawn_by_cpu, figure, id, ids, incoming, jpeg, listed, noise, picture, seconds_now,
    serves_others, spoilt, spoilt_map, state, usual, wait_until, with_rooms,
};
pub use crate::key_fixture::Scope;
pub use crate::makers::{Does, Gate, SlowDrawing, bright, failing, models, pipeline, way_within, with_network};
