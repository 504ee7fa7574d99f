//! Messages of a room, in which a tiled multiplane image moves (schema in `proto/live.proto`).
//!
//! The picture travels as video, and its planes and labels beside it in [`chunk`]s of a few tiles. A chunk needs no other one, so that a
//! reader may miss any; what it is sent is the chunks of tiles that it has not got. [`Model`] is what a reader knows of all tiles, and
//! [`Layers`] what it shows of them.

mod changed_blocks;
pub mod chunk;
pub mod coder_prior;
mod fuzzing;
#[cfg(feature = "video")]
mod key_frame_header;
pub mod label_motion;
mod layers;
#[doc(hidden)]
pub mod schema;
mod shown_frames;
mod tile_state;
mod yuv;

#[doc(hidden)]
pub use fuzzing::message as fuzz_message;
#[cfg(feature = "video")]
pub use key_frame_header::{KeyFrame, KeyFrameError, key_frame};
pub use layers::{Changes, FOLLOWS, Layers};
pub use shown_frames::When;
pub use tile_state::Model;
pub use yuv::{Colour, I420, Matrix, to_rgb};

use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};
use prost::{DecodeError, Message as _};
use schema::Message;
use schema::message::Kind;

/// Version of the messages.
pub const VERSION: u32 = 1;
/// Bytes of a message, at most.
pub const MAX_MESSAGE: usize = 4 << 20;
/// Pixels of a frame, at most: 1920×1088.
pub const MAX_PIXELS: u64 = 1920 * 1088;
/// Labelled planes a tile, at most.
pub const MAX_PLANES: usize = 16;
/// Chunks of a message, at most.
const MAX_CHUNKS: usize = 4096;
/// Smallest tile in pixels.
const LEAST_TILE: u32 = 16;
/// Fields of a message that hold chunks.
const GEOMETRY: u32 = 3;
const SNAPSHOT: u32 = 4;

/// Why a message cannot be taken.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// It is malformed or exceeds a bound; the text names what.
    #[error("not a message that can be read: {0}")]
    Broken(String),
    /// It is of a newer version.
    #[error("messages of version {found}; this program reads up to version {VERSION}")]
    Newer {
        /// Version found.
        found: u32,
    },
    /// Planes or labels do not fit together.
    #[error(transparent)]
    Container(#[from] crate::container::ContainerError),
}

impl LiveError {
    fn broken(what: impl Into<String>) -> Self {
        Self::Broken(what.into())
    }
}

/// The bytes of a message.
#[must_use]
pub fn write(kind: Kind) -> prost::bytes::Bytes {
    Message { kind: Some(kind) }.encode_to_vec().into()
}

/// Reads a message. What it holds of video shares the memory of `bytes`.
///
/// # Errors
/// [`LiveError::Broken`] where it is too long, none, or of no kind that is known.
pub fn read(bytes: prost::bytes::Bytes) -> Result<Kind, LiveError> {
    if bytes.len() > MAX_MESSAGE {
        return Err(LiveError::broken(format!("{} bytes, over {MAX_MESSAGE}", bytes.len())));
    }
    let wrong = |e: DecodeError| LiveError::broken(e.to_string());
    let chunks = chunks(&bytes).map_err(wrong)?;
    if chunks > MAX_CHUNKS {
        return Err(LiveError::broken(format!("{chunks} chunks, over {MAX_CHUNKS}")));
    }
    Message::decode(bytes).map_err(wrong)?.kind.ok_or_else(|| LiveError::broken("of no known kind"))
}

/// Parts of a message that can be chunks, counted before any memory is taken for them: an empty one has two bytes, and takes a hundred.
fn chunks(mut message: &[u8]) -> Result<usize, DecodeError> {
    let mut count = 0;
    while !message.is_empty() {
        let (field, wire) = decode_key(&mut message)?;
        if wire != WireType::LengthDelimited {
            skip_field(wire, field, &mut message, DecodeContext::default())?;
            continue;
        }
        let length = usize::try_from(decode_varint(&mut message)?).unwrap_or(usize::MAX);
        // what is cut off is told by the decoder
        let mut inner = message.split_off(..length.min(message.len())).unwrap_or_default();
        while matches!(field, GEOMETRY | SNAPSHOT) && !inner.is_empty() {
            let (field, wire) = decode_key(&mut inner)?;
            count += usize::from(wire == WireType::LengthDelimited);
            skip_field(wire, field, &mut inner, DecodeContext::default())?;
        }
    }
    Ok(count)
}

#[cfg(test)]
mod tests;
