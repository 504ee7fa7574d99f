//! Prints the results of the native decoder; tests/browser/decode/native.test.mjs compares the wasm decoder with them.
//!
//! `native pixels FILE` writes the decoded photo as RGBA, row by row. `native digests FILE < STRIPS` writes the digest of the layers
//! (`Scene::digest`) and SHA-256 over all strips of texture pages. For each strip, STRIPS has its width, height and number of pieces,
//! followed by the integers of each piece (`Decoder::strip`), all u32 little-endian.

use std::error::Error;
use std::io::{Read, Write};

use sha2::{Digest, Sha256};
use tmpi_core::container::{Piece, decode};
use tmpi_decoder::{Decoder, Output};

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let (what, file) = args.next().zip(args.next()).ok_or("usage: native pixels|digests FILE")?;
    let bytes = std::fs::read(file)?;
    let scene = decode(&bytes)?;
    let rgba: Vec<u8> = scene.photo.rgb.iter().flat_map(|&[r, g, b]| [r, g, b, u8::MAX]).collect();
    if what == "pixels" {
        return Ok(std::io::stdout().write_all(&rgba)?);
    }
    let mut decoder = Decoder::default();
    decoder.room(bytes.len()).copy_from_slice(&bytes);
    decoder.open();
    decoder.room(rgba.len()).copy_from_slice(&rgba);
    decoder.picture(false, (scene.grid.width, scene.grid.height), 0);
    decoder.decode(0..scene.grid.rows())?;
    let mut strips = Vec::new();
    std::io::stdin().read_to_end(&mut strips)?;
    let mut hash = Sha256::new();
    let mut rest = strips.as_slice();
    while let Some((head, after)) = rest.split_at_checked(12) {
        let [width, height, count] = [0, 4, 8].map(|at| head[at..].first_chunk().map_or(0, |n| u32::from_le_bytes(*n)) as usize);
        let (pieces, after) = after.split_at_checked(count * Piece::NUMBERS * 4).ok_or("the strips are cut off")?;
        decoder.room(pieces.len()).copy_from_slice(pieces);
        decoder.strip((width, height), false)?;
        hash.update(decoder.output(Output::Strip as u32));
        rest = after;
    }
    let strips = hash.finalize().iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
    println!("{} {strips}", scene.digest());
    Ok(())
}
