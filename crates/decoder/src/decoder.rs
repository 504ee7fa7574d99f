//! The state of an instance, and its functions.

use std::ops::Range;

use tmpi_core::container::{PhotoRows, Piece, TileLayers, decode_rows, strip};
use tmpi_core::{BorderColours, Class, Photo};

/// Results that can be read.
#[derive(Clone, Copy, Debug)]
#[repr(u32)]
pub enum Output {
    /// Why the last call failed: text.
    Text = 0,
    /// Text of a panic.
    Panic = 1,
    /// Numbers of the layers (see `Decoder::decode`), 64-bit floats, little-endian.
    Numbers = 2,
    /// Classes of all texels.
    Class = 3,
    /// Alphas of all texels.
    Alpha = 4,
    /// Colours of the hidden texels, three bytes each.
    Hidden = 5,
    /// The last strip, four bytes per texel.
    Strip = 6,
}

/// Number of columns in [`Output::Numbers`].
const COLUMNS: usize = 10;

/// One container, or one band of its tiles.
#[derive(Default)]
pub struct Decoder {
    input: Vec<u8>,
    container: Vec<u8>,
    photo: PhotoRows,
    /// Colours beyond the photo's borders, taken when the first strip is requested.
    beyond: Option<BorderColours>,
    hidden: Option<Photo>,
    part: TileLayers,
    numbers: Vec<u8>,
    strip: Vec<[u8; 4]>,
    /// Why the last call failed.
    pub text: String,
}

impl Decoder {
    /// The input buffer of the next call, resized to `length` bytes.
    pub fn room(&mut self, length: usize) -> &mut [u8] {
        self.input.resize(length, 0);
        &mut self.input
    }

    /// Takes the input buffer as the container.
    pub fn open(&mut self) {
        self.container = std::mem::take(&mut self.input);
    }

    /// Takes the input buffer as the next rows of a picture, RGBA.
    pub fn picture(&mut self, hidden: bool, (width, height): (u32, u32), top: u32) {
        let rgb = self.input.as_chunks::<4>().0.iter().map(|&[r, g, b, _]| [r, g, b]);
        if hidden {
            self.hidden.get_or_insert_with(|| Photo { width, height, rgb: Vec::new() }).rgb.extend(rgb);
        } else {
            if self.photo.rgb.is_empty() {
                self.photo = PhotoRows { width, height, top, rgb: Vec::new() };
            }
            self.photo.rgb.extend(rgb);
        }
        self.input = Vec::new();
    }

    /// Decodes rows of tiles. Stores ten columns of numbers, with one value per layer: a, b, c of the plane, x, y, w, h of the rectangle,
    /// tile, number of visible texels, and whether any texel is soft.
    ///
    /// # Errors
    /// The container is damaged, or rows of the photo are missing.
    pub fn decode(&mut self, rows: Range<u32>) -> Result<i32, String> {
        // ignores an incomplete picture
        let hidden = self.hidden.as_ref().filter(|p| p.rgb.len() == p.width as usize * p.height as usize);
        self.part = decode_rows(&self.container, &rows, &self.photo, hidden).map_err(|e| e.to_string())?;
        (self.container, self.input, self.hidden) = (Vec::new(), Vec::new(), None);
        let (layers, texels) = (&self.part.layers, &self.part.texels);
        self.numbers = vec![0; layers.len() * COLUMNS * size_of::<f64>()];
        let (numbers, _) = self.numbers.as_chunks_mut();
        for (i, l) in layers.iter().enumerate() {
            let own = l.first_texel..l.first_texel + l.rect.area();
            let visible = texels.class[own.clone()].iter().filter(|&&c| c == Class::Photo as u8).count();
            let soft = texels.alpha[own].iter().any(|&a| a < u8::MAX);
            let [x, y, w, h] = [l.rect.x, l.rect.y, l.rect.w, l.rect.h].map(f64::from);
            let (p, soft) = (l.plane, f64::from(u8::from(soft)));
            let row: [f64; COLUMNS] = [p.a, p.b, p.c, x, y, w, h, f64::from(l.tile), visible as f64, soft];
            for (column, value) in row.into_iter().enumerate() {
                numbers[column * layers.len() + i] = value.to_le_bytes();
            }
        }
        Ok(1)
    }

    /// Renders the pieces in the input buffer into a strip of `size` (width, height), with straight or premultiplied alpha.
    ///
    /// # Errors
    /// A piece does not fit into its layer or the strip.
    pub fn strip(&mut self, size: (usize, usize), straight: bool) -> Result<i32, String> {
        let numbers: Vec<u32> = self.input.as_chunks().0.iter().map(|n| u32::from_le_bytes(*n)).collect();
        let pieces = numbers.as_chunks().0.iter().map(Piece::of);
        let photo = &self.photo;
        let beyond = self.beyond.get_or_insert_with(|| BorderColours::new(&photo.rgb, [photo.width, photo.height], photo.top));
        self.strip = strip(&self.part, (photo, beyond), pieces, size, straight).ok_or("a piece does not fit")?;
        Ok(1)
    }

    /// The bytes of the result with the number of an [`Output`].
    pub fn output(&self, what: u32) -> &[u8] {
        const OUTPUTS: [Output; 6] = [Output::Text, Output::Numbers, Output::Class, Output::Alpha, Output::Hidden, Output::Strip];
        match OUTPUTS.into_iter().find(|o| *o as u32 == what) {
            Some(Output::Text) => self.text.as_bytes(),
            Some(Output::Numbers) => &self.numbers,
            Some(Output::Class) => &self.part.texels.class,
            Some(Output::Alpha) => &self.part.texels.alpha,
            Some(Output::Hidden) => self.part.texels.hidden.as_flattened(),
            Some(Output::Strip) => self.strip.as_flattened(),
            Some(Output::Panic) | None => &[],
        }
    }
}
