//! Texels as the graphics device takes them: strips of texture pages.

use super::{Part, PhotoRows};
use crate::{Class, Layer};

/// A part of a layer in a strip.
#[derive(Clone, Copy, Debug)]
pub struct Piece {
    /// Number of the layer.
    pub layer: usize,
    /// First column and row taken of it.
    pub from: (usize, usize),
    /// Columns and rows taken.
    pub size: (usize, usize),
    /// Whether columns and rows run backward.
    pub mirrored: (bool, bool),
    /// First column in the strip.
    pub x: usize,
}

impl Piece {
    /// Numbers of a piece: layer, first column, first row, columns, rows, mirrored (1: columns, 2: rows), column in the strip.
    pub const NUMBERS: usize = 7;

    /// Takes a piece out of its numbers.
    #[must_use]
    pub fn of(n: &[u32; Self::NUMBERS]) -> Self {
        let [layer, u, v, w, h, flags, x] = n.map(|n| n as usize);
        Self { layer, from: (u, v), size: (w, h), mirrored: (flags & 1 != 0, flags & 2 != 0), x }
    }

    /// Whether it lies within its layer and within a strip.
    fn fits(&self, layer: &Layer, (width, height): (usize, usize)) -> bool {
        let within = |from: usize, size: usize, most: usize| from.checked_add(size).is_some_and(|end| end <= most);
        within(self.from.0, self.size.0, layer.rect.w as usize)
            && within(self.from.1, self.size.1, layer.rect.h as usize)
            && within(self.x, self.size.0, width)
            && self.size.1 <= height
    }
}

/// Premultiplied or straight RGBA of a strip of `size`, row by row; none where a piece does not fit.
#[must_use]
pub fn strip(
    part: &Part,
    photo: &PhotoRows,
    pieces: impl Iterator<Item = Piece>,
    size: (usize, usize),
    straight: bool,
) -> Option<Vec<[u8; 4]>> {
    let mut out = vec![[0; 4]; size.0.checked_mul(size.1)?];
    for piece in pieces {
        let layer = part.layers.get(piece.layer).filter(|layer| piece.fits(layer, size))?;
        expand(part, photo, layer, &piece, &mut out, size.0);
    }
    if !straight {
        out.iter_mut().for_each(premultiply);
    }
    Some(out)
}

/// Adds the texels of a piece of a layer to `out`, row by row, premultiplied. False, and nothing is added, where the piece does not fit its layer, or
/// has a place in a strip.
#[must_use]
pub fn cell(part: &Part, photo: &PhotoRows, piece: &Piece, out: &mut Vec<[u8; 4]>) -> bool {
    let Some(layer) = part.layers.get(piece.layer).filter(|layer| piece.fits(layer, piece.size)) else { return false };
    let from = out.len();
    out.resize(from + piece.size.0 * piece.size.1, [0; 4]);
    expand(part, photo, layer, piece, &mut out[from..], piece.size.0);
    let texels = layer.first_texel..layer.first_texel + layer.rect.area();
    // what is not there is 0 already
    if part.texels.alpha[texels].iter().any(|a| (1..u8::MAX).contains(a)) {
        out[from..].iter_mut().for_each(premultiply);
    }
    true
}

#[inline(never)]
fn expand(part: &Part, photo: &PhotoRows, l: &Layer, piece: &Piece, out: &mut [[u8; 4]], width: usize) {
    let (w, h) = piece.size;
    let hidden_of = |class: &[u8]| class.iter().filter(|&&c| c == Class::Hidden as u8).count();
    let texel = |v: usize| l.first_texel + v * l.rect.w as usize;
    // hidden colours lie in a row, so those before the piece are counted too
    let mut hidden = l.first_hidden + hidden_of(&part.texels.class[texel(0)..texel(piece.from.1)]);
    for v in 0..h {
        let y = piece.from.1 + v;
        let class = &part.texels.class[texel(y)..texel(y + 1)];
        let (before, class) = class.split_at(piece.from.0);
        let (class, after) = class.split_at(w);
        hidden += hidden_of(before);
        let alpha = &part.texels.alpha[texel(y) + piece.from.0..][..w];
        let pixel = (l.rect.y as usize + y - photo.top as usize) * photo.width as usize + l.rect.x as usize + piece.from.0;
        let row = if piece.mirrored.1 { h - 1 - v } else { v };
        let to = &mut out[row * width + piece.x..][..w];
        let colours = &part.texels.hidden[hidden..];
        hidden += fill(class, alpha, &photo.rgb[pixel..pixel + w], colours, to) + hidden_of(after);
        if piece.mirrored.0 {
            to.reverse();
        }
    }
}

/// Writes a row; gives the count of hidden colours that it took. Empty texels become 0.
fn fill(class: &[u8], alpha: &[u8], photo: &[[u8; 3]], hidden: &[[u8; 3]], to: &mut [[u8; 4]]) -> usize {
    // without a branch: most rows have none that is hidden
    for (((to, &class), &a), [r, g, b]) in to.iter_mut().zip(class).zip(alpha).zip(photo) {
        let all = if class == Class::Photo as u8 { u32::MAX } else { 0 };
        *to = (u32::from_le_bytes([*r, *g, *b, a]) & all).to_le_bytes();
    }
    if !class.contains(&(Class::Hidden as u8)) {
        return 0;
    }
    let texels = to.iter_mut().zip(alpha).zip(class).filter(|(_, class)| **class == Class::Hidden as u8);
    texels.zip(hidden).map(|(((to, a), _), [r, g, b])| *to = [*r, *g, *b, *a]).count()
}

/// Colour times alpha, rounded to nearest.
fn premultiply(texel: &mut [u8; 4]) {
    let a = u32::from(texel[3]);
    if a == 0 {
        *texel = [0; 4];
    } else if a < 255 {
        for v in &mut texel[..3] {
            *v = ((u32::from(*v) * a + 127) / 255) as u8;
        }
    }
}
