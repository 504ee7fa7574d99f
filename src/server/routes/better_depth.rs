//! Whether this node's network would give a photo better depth.

use crate::server::app_state::{AppState, StoredFile};
use tmpi_library::{Part, Photo};
use tmpi_pipeline::networks::models::registry::better_than;

/// What a report says of its photo's depth.
#[derive(serde::Deserialize)]
struct MadeBy {
    depth_model: String,
}

/// Name of this node's network, if it is better than the one that estimated the photo's depth and the caller may have the photo made again.
/// `None` if the depth was uploaded or came with the photo, or if the report cannot be read.
pub(super) async fn better_depth(app: &AppState, photo: &Photo) -> Option<String> {
    let network = app.maker.network().to_owned();
    let worse = better_than(&network);
    if worse.is_empty() || app.guard.as_ref().is_some_and(|guard| !guard.may_change(photo)) {
        return None;
    }
    // a request for the report itself answers with the error
    let StoredFile { source, .. } = app.file(photo, Part::Report).await.ok()?;
    let MadeBy { depth_model } = serde_json::from_slice(&source.head(source.len()).await.ok()?).ok()?;
    worse.iter().any(|kind| depth_model.starts_with(kind)).then_some(network)
}
