//! The files of a photo as the store has them, of which this node keeps copies.

use std::io;

use super::Cluster;
use super::ports::unreachable;
use super::records;
use crate::server::id::PhotoId;
use crate::server::part::Part;
use crate::server::records::End;
use crate::server::store::{Origin, digest};

impl Origin for Cluster {
    fn fetch(&self, id: PhotoId, part: Part) -> io::Result<Vec<u8>> {
        let none = || io::Error::from(io::ErrorKind::NotFound);
        if self.is_away() {
            return Err(unreachable("it could not be reached just now"));
        }
        let known = self.known().get(&id).cloned().ok_or_else(none)?;
        let name = match part {
            Part::Upload | Part::Depth => records::blob(id, &known.photo.source, part),
            Part::Strokes => known.photo.strokes.ok_or_else(none)?,
            Part::Report | Part::Atlas | Part::Disparity | Part::Thumbnail => {
                format!("{}.{}", known.end.as_ref().ok_or_else(none)?.blobs, part.name())
            }
            Part::Options | Part::State | Part::Settings => return Err(none()),
        };
        let bytes = self.heard(self.blobs.read(&name));
        if bytes.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
            // another node may have made it again
            self.stale(id);
        }
        let bytes = bytes?;
        let whole = match known.end.map(|end| end.outcome) {
            Some(End::Done(done)) if part == Part::Atlas => digest(&bytes) == done.atlas_hash,
            _ => true,
        };
        // as good as none
        if whole { Ok(bytes) } else { Err(none()) }
    }

    fn version(&self, id: PhotoId) -> Option<String> {
        let known = self.known();
        let known = known.get(&id)?;
        Some(format!("{} {}", known.photo.making, known.end.as_ref().map_or("", |end| &end.blobs)))
    }
}
