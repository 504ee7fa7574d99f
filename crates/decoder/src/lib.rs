//! The decoder of a page: `tmpi-core` as WebAssembly, behind a few C functions that `static/decode/decoder.js` calls.
//!
//! An instance decodes one container, or one band of its tiles. What is handed over lies in a buffer that [`tmpi_room`] makes; what
//! comes out is read from the places that [`tmpi_output`] and [`tmpi_output_length`] name. No call takes a pointer, so nothing here
//! is unsafe but the names. A call that fails gives −1 and leaves a text; so does a panic, which ends the instance.

mod decoder;

use std::cell::RefCell;

pub use decoder::{Decoder, Output};

thread_local! {
    static DECODER: RefCell<Decoder> = const { RefCell::new(Decoder::new()) };
}

/// What a call gives where it failed.
const FAILED: i32 = -1;

/// Makes room for so many bytes to be handed to the next call; gives where they are to be written.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_room(length: usize) -> *mut u8 {
    std::panic::set_hook(Box::new(|panic| {
        // a panic within a call holds the decoder, so its text lies apart
        PANIC.set(panic.to_string());
    }));
    DECODER.with_borrow_mut(|decoder| decoder.room(length).as_mut_ptr())
}

thread_local! {
    static PANIC: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Takes over a container; its pictures need not be in it, but zeros in their place.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_open() -> i32 {
    call(|decoder| {
        decoder.open();
        Ok(1)
    })
}

/// Takes over rows of a picture of so many pixels as RGBA, the next ones or the first, which is row `top`. `kind` 0: the photo, 1: the
/// picture of hidden colours.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_picture(kind: u32, width: u32, height: u32, top: u32) -> i32 {
    call(|decoder| {
        decoder.picture(kind == 1, (width, height), top);
        Ok(1)
    })
}

/// Decodes rows of tiles.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_decode(first: u32, end: u32) -> i32 {
    call(|decoder| decoder.decode(first..end))
}

/// Fills a strip of a texture page with the pieces that were handed over, seven numbers each (see [`tmpi_core::container::Piece`]): premultiplied RGBA, or
/// straight where that is 1.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_strip(width: u32, height: u32, straight: u32) -> i32 {
    call(|decoder| decoder.strip((width as usize, height as usize), straight == 1))
}

/// Where a result lies, by the number of an [`Output`]. It stays until the next call that makes or changes it.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_output(what: u32) -> *const u8 {
    output(what, <[u8]>::as_ptr)
}

/// Its length in bytes.
#[allow(unsafe_code, reason = "a C name")]
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_output_length(what: u32) -> usize {
    output(what, <[u8]>::len)
}

fn call(f: impl FnOnce(&mut Decoder) -> Result<i32, String>) -> i32 {
    DECODER.with_borrow_mut(|decoder| {
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
    DECODER.with_borrow(|decoder| f(decoder.output(what)))
}
