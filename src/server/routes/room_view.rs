//! Views of the frames of rooms: drawn as those of photos are, under the same bounds, and once for all who ask for the same.

use std::io::Cursor;

use axum::http::{HeaderMap, Uri, header};
use axum::response::Response;
use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::derived::Derived;
use super::view::{Subject, count, draw, picked};
use super::view_query::ViewQuery;
use crate::server::app::{App, Frame, Stored, Version};
use crate::server::conditional::{Coding, Entity, insert, respond};
use crate::server::id::{PhotoId, hex};
use crate::server::pool::Class;
use crate::server::problem::Problem;
use crate::server::source::Source;
use tmpi_core::container::{self, MEDIA_TYPE};

/// Draws them.
#[derive(Clone)]
pub struct RoomViews(App);

/// A view that is asked for.
pub struct RoomView(ViewQuery);

impl RoomViews {
    /// By what a server draws with.
    #[must_use]
    pub const fn new(app: App) -> Self {
        Self(app)
    }

    /// What a query asks for, and the token that stands in it.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice or out of range.
    pub fn read(&self, uri: &Uri) -> Result<(RoomView, Option<String>), Problem> {
        ViewQuery::of_room(uri, &self.0.limits).map(|(query, token)| (RoomView(query), token))
    }

    /// The container of a frame that is made of what is kept of it, with so many bytes of memory: once for all who ask, as smaller levels of photos
    /// are. `frame`: the room, the epoch and the number.
    ///
    /// # Errors
    /// 503 where too much waits, 500, and those of `make`.
    pub async fn frame(
        &self,
        (room, epoch, number): (&str, u64, u64),
        memory: u64,
        make: impl FnOnce() -> Result<Vec<u8>, Problem> + Send + 'static,
    ) -> Result<Bytes, Problem> {
        let app = &self.0;
        let of = PhotoId::of(&Sha256::digest(format!("{room} {epoch}")).into(), None, "", "epoch");
        let made = async {
            let slot = app.pool.enter(Class::Derived, memory).await?;
            Ok(Frame(slot.run(make).await??.into()))
        };
        app.frames.get((of, number), made).await.map(|Frame(bytes)| bytes)
    }

    /// The container of a frame as an answer, which caches may keep as `cache_control` says.
    pub fn container(container: Bytes, headers: &HeaderMap, cache_control: &str) -> Response {
        let etag = format!("\"{}\"", hex(&Sha256::digest(&container)[..16]));
        let source = Source::Memory(container);
        respond(headers, Entity { source, etag: &etag, content_type: MEDIA_TYPE, cache_control, coding: Coding::Plain })
    }

    /// A view of the frame in a container, which caches may keep as `cache_control` says.
    ///
    /// # Errors
    /// 400 where the size is over the limits, 406 for want of a format, 503 where too much waits, 500.
    pub async fn answer(
        &self,
        RoomView(query): &RoomView,
        container: Bytes,
        headers: &HeaderMap,
        cache_control: &'static str,
    ) -> Result<Response, Problem> {
        let app = &self.0;
        let photo = size_of(&container).map_err(|e| Problem::internal("reading a frame", &e))?;
        let size = query.size(photo, &app.limits)?;
        let format = picked(query.format, headers)?;
        // the same container is the same frame, at whichever node it was made
        let frame: Version = (PhotoId::of(&Sha256::digest(&container).into(), None, "", "frame"), 0);
        let name = format!("{} {} {size:?} {format:?} {:?}", app.build, frame.0, query.canonical());
        let derived = Derived::of_frame(&name, cache_control);
        if let Some(mut response) = derived.known(headers) {
            insert(&mut response, header::VARY, "Accept");
            return Ok(response);
        }
        let mut timing = Vec::new();
        // whoever asks for the same view meanwhile waits for this one
        let drawn = async {
            let (bytes, took) = draw(app, Subject::Frame(frame, container, photo), query, size, format).await?;
            timing = took;
            Ok::<_, Problem>(Stored::derived_in_memory(&derived.made, bytes))
        };
        let stored = app.frame_views.get((frame, derived.made.clone()), drawn).await?;
        count(app, &timing);
        let mut response = derived.answer(headers, stored, format.media_type(), &timing);
        insert(&mut response, header::VARY, "Accept");
        Ok(response)
    }
}

/// Width and height of the picture in a container, by the head of its file.
fn size_of(bytes: &[u8]) -> Result<(u32, u32), String> {
    let sections = container::sections(bytes).map_err(|e| e.to_string())?;
    let photo = sections.iter().find(|s| s.kind == "photo").ok_or("there is no photo section")?;
    let range = photo.offset as usize..(photo.offset + photo.length) as usize;
    let file = bytes.get(range).ok_or("the photo is cut off")?;
    let reader = image::ImageReader::new(Cursor::new(file)).with_guessed_format().map_err(|e| e.to_string())?;
    reader.into_dimensions().map_err(|e| e.to_string())
}
