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

/// Fills `out`, `size` texels row by row, with a piece of a layer, premultiplied; what it does not reach stays as it is. False where the
/// piece does not fit.
#[must_use]
pub fn cell(part: &Part, photo: &PhotoRows, piece: &Piece, out: &mut [[u8; 4]], size: (usize, usize)) -> bool {
    let Some(layer) = part.layers.get(piece.layer).filter(|layer| piece.fits(layer, size)) else { return false };
    expand(part, photo, layer, piece, out, size.0);
    for row in out.chunks_mut(size.0).take(piece.size.1) {
        row[piece.x..piece.x + piece.size.0].iter_mut().for_each(premultiply);
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

/// Writes a row; gives the count of hidden colours that it took.
fn fill(class: &[u8], alpha: &[u8], photo: &[[u8; 3]], hidden: &[[u8; 3]], to: &mut [[u8; 4]]) -> usize {
    let mut taken = 0;
    for (((to, &class), &a), p) in to.iter_mut().zip(class).zip(alpha).zip(photo) {
        let [r, g, b] = if class == Class::Photo as u8 {
            *p
        } else if class == Class::Hidden as u8 {
            taken += 1;
            hidden[taken - 1]
        } else {
            continue;
        };
        *to = [r, g, b, a];
    }
    taken
}

/// Colour times alpha, rounded to nearest.
fn premultiply(texel: &mut [u8; 4]) {
    let a = u32::from(texel[3]);
    if a < 255 {
        for v in &mut texel[..3] {
            *v = ((u32::from(*v) * a + 127) / 255) as u8;
        }
    }
}
