//! The decoder of a page: `tmpi-core` as WebAssembly, behind a few C functions that `static/decode/decoder.js` calls.
//!
//! An instance decodes one container, or one band of its tiles. The caller writes the input of a call to the buffer at [`tmpi_room`], and
//! reads results at [`tmpi_output`], of length [`tmpi_output_length`]. No function takes a pointer, so only their exported names are
//! unsafe. A failed call returns −1 and leaves an error text; a panic does the same, and ends the instance.
#![allow(unsafe_code, reason = "exports C symbols")]

#[deny(unsafe_code)]
mod decoder;

use std::cell::RefCell;

pub use decoder::{Decoder, Output};

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

/// Takes the input buffer as the container. The bytes of its pictures may be replaced by zeros.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_open() -> i32 {
    call(|decoder| {
        decoder.open();
        Ok(1)
    })
}

/// Takes the input buffer as rows of a picture of `width` × `height` pixels, RGBA. The first call starts at row `top`; later calls
/// continue. `kind` is 0 for the photo, 1 for the picture of hidden colours.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_picture(kind: u32, width: u32, height: u32, top: u32) -> i32 {
    call(|decoder| {
        decoder.picture(kind == 1, (width, height), top);
        Ok(1)
    })
}

/// Decodes rows of tiles from `first` to before `end`.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_decode(first: u32, end: u32) -> i32 {
    call(|decoder| decoder.decode(first..end))
}

/// Renders the pieces in the input buffer, seven integers each (see [`tmpi_core::container::Piece`]), into a strip of a texture page: RGBA
/// with straight alpha if `straight` is 1, otherwise premultiplied.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_strip(width: u32, height: u32, straight: u32) -> i32 {
    call(|decoder| decoder.strip((width as usize, height as usize), straight == 1))
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
