//! The decoder of a room's page: `tmpi-core` as WebAssembly, behind a few C functions that `static/live/decoder.js` calls. A separate
//! module, so that pages of photos need not load it.
//!
//! An instance reads and writes the messages of one connection and holds the layers of one room. The caller writes the input of a call to
//! the buffer at [`tmpi_room`], and reads results at [`tmpi_output`], of length [`tmpi_output_length`]. No function takes a pointer, so
//! only their exported names are unsafe. A failed call returns −1 and leaves an error text; a panic does the same, and ends the instance.
#![allow(unsafe_code, reason = "exports C symbols")]

#[deny(unsafe_code)]
mod decoder;

use std::cell::RefCell;

pub use decoder::{Decoder, Output, Pixels};

thread_local! {
    static DECODER: RefCell<Option<Decoder>> = const { RefCell::new(None) };
    static PANIC: RefCell<String> = const { RefCell::new(String::new()) };
}

/// The return value of a failed call.
const FAILED: i32 = -1;

/// Allocates the input buffer of the next call; returns its address.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_room(length: usize) -> *mut u8 {
    std::panic::set_hook(Box::new(|panic| {
        // a panic in a call holds the borrow of the decoder, so its text is stored separately
        PANIC.set(panic.to_string());
    }));
    DECODER.with_borrow_mut(|decoder| held(decoder).room(length).as_mut_ptr())
}

/// Reads the message in the input buffer; returns the number of its kind in `proto/live.proto`. Its numbers and bytes are outputs.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_message() -> i32 {
    call(Decoder::message)
}

/// Takes the input buffer as the next frame, a picture of the size in HELLO. `format` is one of [`Pixels`], `number` the frame's number,
/// and `time` its capture time in µs by the publisher's clock.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_frame(format: u32, number: f64, time: f64) -> i32 {
    call(|decoder| decoder.frame(format, number as u64, time as u64))
}

/// Updates the layers to the last frame and tiles; returns the number of changed tiles, or 0 before the first frame and all tiles.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_layers() -> i32 {
    call(|decoder| Ok(decoder.layers()))
}

/// Stores the texels of the layers in the input buffer, two 32-bit numbers each: the tile, and the layer's index in it. Then come the means
/// along the frame's borders, 28 rows of `columns` texels.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_cells(columns: usize) -> i32 {
    call(|decoder| decoder.cells(columns))
}

/// Writes HELLO of a publisher. The input buffer has the codec strings of video and sound, one per line.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_write_hello(width: u32, height: u32, fov_x: f64, sound_rate: u32, sound_channels: u32) -> i32 {
    call(|decoder| decoder.write_hello((width, height), fov_x, (sound_rate, sound_channels)))
}

/// Writes VIDEO of a temporal layer with the input buffer as data.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_write_video(frame: f64, time: f64, key: u32, layer: u32) -> i32 {
    call(|decoder| Ok(decoder.write_video(frame as u64, time as u64, key == 1, layer)))
}

/// Writes SOUND with the input buffer as data.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_write_sound(time: f64) -> i32 {
    call(|decoder| Ok(decoder.write_sound(time as u64)))
}

/// Writes BYE with the input buffer as reason.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_write_bye() -> i32 {
    call(|decoder| Ok(decoder.write_bye()))
}

/// Address of a result, by the number of an [`Output`]. It is valid until the next call that changes the result.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_output(what: u32) -> *const u8 {
    output(what, <[u8]>::as_ptr)
}

/// Length of a result in bytes.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_output_length(what: u32) -> usize {
    output(what, <[u8]>::len)
}

/// The decoder, a new one at the first call. If the variable held one from the start, the module would have code to drop it.
#[inline(never)]
fn held(decoder: &mut Option<Decoder>) -> &mut Decoder {
    decoder.get_or_insert_default()
}

fn call(f: impl FnOnce(&mut Decoder) -> Result<i32, String>) -> i32 {
    DECODER.with_borrow_mut(|decoder| {
        let decoder = held(decoder);
        f(decoder).unwrap_or_else(|text| {
            decoder.text = text;
            FAILED
        })
    })
}

fn output<T>(what: u32, f: impl Fn(&[u8]) -> T) -> T {
    if what == Output::Panic as u32 {
        return PANIC.with_borrow(|text| f(text.as_bytes()));
    }
    DECODER.with_borrow(|decoder| f(decoder.as_ref().map_or(&[], |decoder| decoder.output(what))))
}
