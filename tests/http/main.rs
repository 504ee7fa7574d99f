//! The HTTP interface, end to end: real sockets, real disk, and where time allows the real way of a photo.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

mod access;
mod access_changes;
mod access_matrix;
mod admin;
mod admission;
mod arrivals;
mod better;
mod carried;
mod client;
mod cluster;
mod cluster_audit;
mod cluster_nats;
mod damage;
mod edges;
mod fixture;
#[path = "../../src/server/cluster/google.rs"]
mod google;

mod events;
mod exports;
mod fair;
mod faults;
mod limits;
mod live;
mod live_access;
mod live_faults;
mod live_hostile;
mod live_streams;
mod manage;
mod manners;
mod matrix;
mod measure;
mod nats;
mod openapi;
mod origins;
mod process;
mod proxies;
mod rates;
mod rest_client;
mod results;
mod retention;
mod settings;
mod sharing;
mod strokes;
mod tls;
mod traces;
mod uploads;
mod versions;
