//! Unpacks zstd sections for the decoder of a page, which has no zstd: `tmpi_core::container::unpacked` as WebAssembly, behind a few C
//! functions that `static/decode/unpack.js` calls. Pages fetch it only for containers with such a section.
//!
//! An instance unpacks one container. As in `tmpi-decoder`, a failed call returns −1 and leaves an error text; a panic ends the instance.
#![allow(unsafe_code, reason = "exports C symbols")]

use std::cell::RefCell;

use tmpi_core::container::unpacked;

/// Results that can be read.
#[derive(Clone, Copy, Debug)]
#[repr(u32)]
pub enum Output {
    /// Why the last call failed: text.
    Text = 0,
    /// Text of a panic.
    Panic = 1,
    /// The container with its sections unpacked.
    Container = 2,
}

/// The return value of a failed call.
const FAILED: i32 = -1;

thread_local! {
    /// The input, then the result.
    static CONTAINER: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
    static TEXT: RefCell<String> = const { RefCell::new(String::new()) };
    static PANIC: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Allocates the input buffer for a container of this length; returns its address.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_room(length: usize) -> *mut u8 {
    std::panic::set_hook(Box::new(|panic| PANIC.set(panic.to_string())));
    CONTAINER.with_borrow_mut(|container| {
        container.resize(length, 0);
        container.as_mut_ptr()
    })
}

/// Unpacks the container.
#[unsafe(no_mangle)]
pub extern "C" fn tmpi_unpack() -> i32 {
    match unpacked(&CONTAINER.take()) {
        Ok(container) => {
            CONTAINER.set(container);
            1
        }
        Err(error) => {
            TEXT.set(error.to_string());
            FAILED
        }
    }
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

fn output<T>(what: u32, f: impl Fn(&[u8]) -> T) -> T {
    const OUTPUTS: [Output; 3] = [Output::Text, Output::Panic, Output::Container];
    match OUTPUTS.into_iter().find(|o| *o as u32 == what) {
        Some(Output::Text) => TEXT.with_borrow(|text| f(text.as_bytes())),
        Some(Output::Panic) => PANIC.with_borrow(|text| f(text.as_bytes())),
        Some(Output::Container) => CONTAINER.with_borrow(|container| f(container)),
        None => f(&[]),
    }
}
