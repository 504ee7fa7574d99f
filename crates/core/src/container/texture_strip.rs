//! Texels in the layout for GPU textures: strips of texture pages.

use super::{PhotoRows, TileLayers};
use crate::scene::packed_rgb;
use crate::{Class, Layer, MirrorBlur};

/// A rectangle of a layer, and its position in a strip.
#[derive(Clone, Copy, Debug)]
pub struct Piece {
    /// Index of the layer.
    pub layer: usize,
    /// First column and row in the layer.
    pub from: (usize, usize),
    /// Number of columns and rows.
    pub size: (usize, usize),
    /// True if columns, rows are reversed.
    pub mirrored: (bool, bool),
    /// First column in the strip; the first row is 0.
    pub x: usize,
}

impl Piece {
    /// Number of integers that encode a piece: layer, first column, first row, columns, rows, mirrored (1: columns, 2: rows), column in the
    /// strip.
    pub const NUMBERS: usize = 7;

    /// Decodes a piece from [`Self::NUMBERS`] integers.
    pub fn of(n: &[u32; Self::NUMBERS]) -> Self {
        let [layer, u, v, w, h, flags, x] = n.map(|n| n as usize);
        Self { layer, from: (u, v), size: (w, h), mirrored: (flags & 1 != 0, flags & 2 != 0), x }
    }

    /// True if the piece lies within its layer and within a strip.
    fn fits(&self, layer: &Layer, (width, height): (usize, usize)) -> bool {
        let within = |from: usize, size: usize, most: usize| from.checked_add(size).is_some_and(|end| end <= most);
        within(self.from.0, self.size.0, layer.rect.w as usize)
            && within(self.from.1, self.size.1, layer.rect.h as usize)
            && within(self.x, self.size.0, width)
            && self.size.1 <= height
    }
}

/// Renders pieces into a strip of `size` (width, height): RGBA, row by row, straight or premultiplied. `blur` must have the same rows as
/// `photo`. `None` if a piece does not fit.
pub fn strip(
    part: &TileLayers,
    (photo, blur): (&PhotoRows, &MirrorBlur),
    pieces: impl Iterator<Item = Piece>,
    size: (usize, usize),
    straight: bool,
) -> Option<Vec<[u8; 4]>> {
    let mut out = vec![[0; 4]; size.0.checked_mul(size.1)?];
    for piece in pieces {
        let layer = part.layers.get(piece.layer).filter(|layer| piece.fits(layer, size))?;
        let rows = Rows { photo, words: Vec::new() };
        if piece.mirrored == (false, false) {
            expand(part, layer, &piece, &mut { rows }, &mut out, size.0);
        } else {
            let mirrored = [piece.mirrored.0, piece.mirrored.1];
            expand(part, layer, &piece, &mut Blurred { rows, blur, mirrored, rgb: Vec::new() }, &mut out, size.0);
        }
    }
    if !straight {
        out.iter_mut().for_each(premultiply);
    }
    Some(out)
}

/// Appends the texels of a layer to `out`, row by row, as premultiplied RGBA. `photo` has the colours of the whole photo, `width` to a row.
pub(crate) fn texels(part: &TileLayers, layer: &Layer, (photo, width): (&[u32], usize), out: &mut Vec<[u8; 4]>) {
    let (from, size) = (out.len(), (layer.rect.w as usize, layer.rect.h as usize));
    out.resize(from + size.0 * size.1, [0; 4]);
    let piece = Piece { layer: 0, from: (0, 0), size, mirrored: (false, false), x: 0 };
    expand(part, layer, &piece, &mut Words { photo, width }, &mut out[from..], size.0);
    let own = layer.first_texel..layer.first_texel + layer.rect.area();
    // empty texels are 0 already
    if part.texels.alpha[own].iter().any(|a| (1..u8::MAX).contains(a)) {
        out[from..].iter_mut().for_each(premultiply);
    }
}

/// Colours of photo pixels, as words.
trait Colours {
    /// Colours of `count` pixels of row `y` from column `x` on.
    fn row(&mut self, x: usize, y: usize, count: usize) -> &[u32];
}

/// Some rows of the photo; converts pixels to words on demand.
struct Rows<'a> {
    photo: &'a PhotoRows,
    words: Vec<u32>,
}

impl Rows<'_> {
    fn rgb(&self, x: usize, y: usize, count: usize) -> &[[u8; 3]] {
        &self.photo.rgb[(y - self.photo.top as usize) * self.photo.width as usize + x..][..count]
    }
}

impl Colours for Rows<'_> {
    fn row(&mut self, x: usize, y: usize, count: usize) -> &[u32] {
        let mut words = std::mem::take(&mut self.words);
        words.resize(count, 0);
        packed_rgb::words(self.rgb(x, y, count), &mut words);
        self.words = words;
        &self.words
    }
}

/// Colours that continue the photo beyond its borders.
struct Blurred<'a> {
    rows: Rows<'a>,
    blur: &'a MirrorBlur,
    mirrored: [bool; 2],
    rgb: Vec<[u8; 3]>,
}

impl Colours for Blurred<'_> {
    fn row(&mut self, x: usize, y: usize, count: usize) -> &[u32] {
        self.rgb.clear();
        self.blur.row(x, y, self.rows.rgb(x, y, count), self.mirrored, &mut self.rgb);
        self.rows.words.resize(count, 0);
        packed_rgb::words(&self.rgb, &mut self.rows.words);
        &self.rows.words
    }
}

/// The whole photo, as words.
struct Words<'a> {
    photo: &'a [u32],
    width: usize,
}

impl Colours for Words<'_> {
    fn row(&mut self, x: usize, y: usize, count: usize) -> &[u32] {
        &self.photo[y * self.width + x..][..count]
    }
}

fn expand(part: &TileLayers, l: &Layer, piece: &Piece, photo: &mut dyn Colours, out: &mut [[u8; 4]], width: usize) {
    let (w, h) = piece.size;
    let hidden_of = |class: &[u8]| class.iter().filter(|&&c| c == Class::Hidden as u8).count();
    let texel = |v: usize| l.first_texel + v * l.rect.w as usize;
    // hidden colours of a layer are contiguous, so count those before the piece
    let mut hidden = l.first_hidden + hidden_of(&part.texels.class[texel(0)..texel(piece.from.1)]);
    for v in 0..h {
        let y = piece.from.1 + v;
        let class = &part.texels.class[texel(y)..texel(y + 1)];
        let (before, class) = class.split_at(piece.from.0);
        let (class, after) = class.split_at(w);
        hidden += hidden_of(before);
        let alpha = &part.texels.alpha[texel(y) + piece.from.0..][..w];
        let row = if piece.mirrored.1 { h - 1 - v } else { v };
        let to = &mut out[row * width + piece.x..][..w];
        let colours = &part.texels.hidden[hidden..];
        let photo = photo.row(l.rect.x as usize + piece.from.0, l.rect.y as usize + y, w);
        hidden += fill(class, alpha, photo, colours, to) + hidden_of(after);
        if piece.mirrored.0 {
            to.reverse();
        }
    }
}

/// Writes a row and returns the number of hidden colours used. Empty texels become 0.
fn fill(class: &[u8], alpha: &[u8], photo: &[u32], hidden: &[[u8; 3]], to: &mut [[u8; 4]]) -> usize {
    // without a branch: most rows have no hidden texels
    for (((to, &class), &a), word) in to.iter_mut().zip(class).zip(alpha).zip(photo) {
        let all = if class == Class::Photo as u8 { u32::MAX } else { 0 };
        *to = ((word | u32::from(a) << 24) & all).to_le_bytes();
    }
    if !class.contains(&(Class::Hidden as u8)) {
        return 0;
    }
    let texels = to.iter_mut().zip(alpha).zip(class).filter(|(_, class)| **class == Class::Hidden as u8);
    texels.zip(hidden).map(|(((to, a), _), [r, g, b])| *to = [*r, *g, *b, *a]).count()
}

/// Multiplies the colour by alpha, rounded to nearest, without a branch: red and blue together, then green.
fn premultiply(texel: &mut [u8; 4]) {
    let word = u32::from_le_bytes(*texel);
    let a = word >> 24;
    // divides two products of 16 bits each by 255, rounded
    let times = |two: u32| {
        let sum = two * a + 0x007f_007f;
        (sum + 0x0001_0001 + (sum >> 8 & 0x00ff_00ff)) >> 8 & 0x00ff_00ff
    };
    *texel = (times(word & 0x00ff_00ff) | times(word >> 8 & 0xff) << 8 | a << 24).to_le_bytes();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Photo, Plane, Rect, Texels};

    #[test]
    fn premultiplication_rounds_every_value_to_nearest() {
        for (v, a) in (0..=255u8).flat_map(|v| (0..=255u8).map(move |a| (v, a))) {
            let mut texel = [v, 255 - v, v / 2, a];
            premultiply(&mut texel);
            let want = [v, 255 - v, v / 2].map(|v| (f64::from(v) * f64::from(a) / 255.0).round() as u8);
            assert_eq!(texel, [want[0], want[1], want[2], a]);
        }
    }

    #[test]
    fn pieces_of_a_layer_join_to_the_whole_layer() {
        let (width, height, rect) = (12, 11, Rect { x: 3, y: 4, w: 7, h: 5 });
        let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 16) as u8;
        let photo = Photo::from_fn(width, height, |x, y| [x as u8, y as u8, noise(x + y * width)]);
        let class: Vec<u8> = (0..35).map(|i| noise(i) % 3).collect();
        let hidden = class.iter().filter(|c| **c == Class::Hidden as u8).zip(0..).map(|(_, n)| [200, n, noise(n.into())]).collect();
        let alpha = class.iter().zip(0..).map(|(c, i)| if *c == 0 { 0 } else { noise(i + 99) | 1 }).collect();
        let layer = Layer { tile: 0, plane: Plane::fronto_parallel(0.5), rect, first_texel: 0, first_hidden: 0 };
        let part = TileLayers { layers: vec![layer], texels: Texels { class, alpha, hidden } };
        let mut words = vec![0; photo.rgb.len()];
        packed_rgb::words(&photo.rgb, &mut words);
        let mut whole = Vec::new();
        texels(&part, &layer, (&words, width as usize), &mut whole);
        assert!(whole.iter().any(|t| t[3] > 0 && t[3] < 255));
        let top = 2;
        let rows = PhotoRows { width, height, top, rgb: photo.rgb[(top * width) as usize..].to_vec() };
        let blur = MirrorBlur::new(&rows.rgb, [width, height], top);
        for (u, v) in (0..7).flat_map(|u| (0..5).map(move |v| (u, v))) {
            let piece = Piece { layer: 0, from: (u, v), size: (7 - u, 5 - v), mirrored: (false, false), x: 1 };
            let strip = strip(&part, (&rows, &blur), std::iter::once(piece), (9, 5), false).unwrap();
            for (x, y) in (0..9).flat_map(|x| (0..5).map(move |y| (x, y))) {
                let within = (1..8 - u).contains(&x) && y < 5 - v;
                let want = if within { whole[(v + y) * 7 + u + x - 1] } else { [0; 4] };
                assert_eq!(strip[y * 9 + x], want, "texel {x}, {y} of the piece from {u}, {v}");
            }
        }
        let outside = Piece { layer: 0, from: (1, 1), size: (7, 4), mirrored: (false, false), x: 0 };
        assert!(strip(&part, (&rows, &blur), std::iter::once(outside), (9, 5), false).is_none());
    }
}
