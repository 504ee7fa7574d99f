//! Messages of a room, a live tiled multiplane image (schema in `proto/live.proto`).
//!
//! The picture is sent as video, and its planes and labels beside it in [`chunk`]s of a few tiles. Each chunk is independent, so a viewer
//! may miss any; it gets the chunks of tiles that it does not have yet. [`TileState`] is a viewer's knowledge of all tiles, and [`Layers`] are
//! what it shows of them.

mod changed_blocks;
pub mod chunk;
pub mod coder_prior;
mod fuzzing;
#[cfg(feature = "video")]
mod key_frame_header;
pub mod label_motion;
mod layers;
mod moved_tile;
#[doc(hidden)]
pub mod schema;
mod shown_frames;
mod tile_state;
mod yuv;

#[doc(hidden)]
pub use fuzzing::message as fuzz_message;
#[cfg(feature = "video")]
pub use key_frame_header::{KeyFrame, KeyFrameError, key_frame};
pub use layers::{Changes, Layers, MAX_MOTION_FRAMES};
pub use shown_frames::FrameTiming;
pub use tile_state::TileState;
pub use yuv::{Colour, I420, Matrix, to_rgb};

use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};
use prost::{DecodeError, Message as _};
use schema::Message;
use schema::message::Kind;

/// Version of the protocol.
pub const VERSION: u32 = 1;
/// Maximum length of a message in bytes.
pub const MAX_MESSAGE: usize = 4 << 20;
/// Maximum number of pixels of a frame: 1920×1088.
pub const MAX_PIXELS: u64 = 1920 * 1088;
/// Maximum number of labelled planes per tile.
pub const MAX_PLANES: usize = 16;
/// Maximum number of chunks per message.
const MAX_CHUNKS: usize = 4096;
/// Minimum tile size in pixels.
const MIN_TILE: u32 = 16;
/// Fields of a message that hold chunks.
const GEOMETRY: u32 = 3;
const SNAPSHOT: u32 = 4;

/// Why a message is rejected.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The message is malformed or exceeds a limit; the text says which.
    #[error("not a readable message: {0}")]
    Broken(String),
    /// The message is of a newer version.
    #[error("messages of version {found}; this program reads up to version {VERSION}")]
    Newer {
        /// Version found.
        found: u32,
    },
    /// Planes or labels are invalid.
    #[error(transparent)]
    Container(#[from] crate::container::ContainerError),
}

impl LiveError {
    fn broken(what: impl Into<String>) -> Self {
        Self::Broken(what.into())
    }
}

/// Encodes a message.
pub fn write(kind: Kind) -> prost::bytes::Bytes {
    Message { kind: Some(kind) }.encode_to_vec().into()
}

/// Decodes a message. Video data shares the memory of `bytes`.
///
/// # Errors
/// [`LiveError::Broken`] if the message is longer than [`MAX_MESSAGE`], malformed, has too many chunks, or is of an unknown kind.
pub fn read(bytes: prost::bytes::Bytes) -> Result<Kind, LiveError> {
    if bytes.len() > MAX_MESSAGE {
        return Err(LiveError::broken(format!("{} bytes, over {MAX_MESSAGE}", bytes.len())));
    }
    let wrong = |e: DecodeError| LiveError::broken(e.to_string());
    let chunks = chunks(&bytes).map_err(wrong)?;
    if chunks > MAX_CHUNKS {
        return Err(LiveError::broken(format!("{chunks} chunks, over {MAX_CHUNKS}")));
    }
    Message::decode(bytes).map_err(wrong)?.kind.ok_or_else(|| LiveError::broken("unknown kind"))
}

/// Counts the fields of a message that can be chunks, before decoding allocates memory for them: an empty chunk has two bytes, but takes a
/// hundred in memory.
fn chunks(mut message: &[u8]) -> Result<usize, DecodeError> {
    let mut count = 0;
    while !message.is_empty() {
        let (field, wire) = decode_key(&mut message)?;
        if wire != WireType::LengthDelimited {
            skip_field(wire, field, &mut message, DecodeContext::default())?;
            continue;
        }
        let length = usize::try_from(decode_varint(&mut message)?).unwrap_or(usize::MAX);
        // the decoder reports truncation
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
