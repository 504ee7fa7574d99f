//! Builds values for the fuzzer's targets from the bytes that the fuzzer generates.

use tmpi_core::{Geometry, Grid, Intrinsics, Plane, Tile, ViewBox};

/// Bytes that decide what to build; reads 0 after their end.
pub struct Script<'a>(pub &'a [u8]);

impl Script<'_> {
    pub fn byte(&mut self) -> u8 {
        self.0.split_off_first().copied().unwrap_or_default()
    }

    /// A number below `end`, which must be at most 256.
    pub fn below(&mut self, end: u32) -> u32 {
        u32::from(self.byte()) % end.max(1)
    }

    pub fn word(&mut self) -> u32 {
        u32::from_le_bytes([(); 4].map(|()| self.byte()))
    }

    /// A side in pixels: usually small, one in sixteen as large as a photo's.
    fn side(&mut self, most: u32) -> u32 {
        let side = 1 + u32::from(self.byte());
        if self.below(16) == 1 { (side * 4).min(most) } else { side.min(96) }
    }

    /// A replacement for `old`: close to it, at an end of the range, or any number.
    pub fn number(&mut self, old: u64) -> u64 {
        match self.below(8) {
            0 => 0,
            1 => 1,
            2 => old.wrapping_add(1),
            3 => old.wrapping_sub(1),
            4 => old.wrapping_mul(2),
            5 => u64::MAX >> self.below(64),
            6 => old ^ 1 << self.below(32),
            _ => self.word().into(),
        }
    }

    /// Replaces one of the fields.
    pub fn change(&mut self, fields: &mut [&mut u32]) {
        let at = self.below(fields.len() as u32) as usize;
        *fields[at] = self.number((*fields[at]).into()) as u32;
    }

    /// Like [`Self::number`], for a length or a position on an axis.
    pub fn real(&mut self, old: f64) -> f64 {
        match self.below(8) {
            0 => 0.0,
            1 => -old,
            2 => f64::NAN,
            3 => f64::INFINITY,
            4 => f64::MIN_POSITIVE,
            5 => 1e300,
            6 => old * 1.5,
            _ => f64::from(f32::from_bits(self.word())),
        }
    }

    /// A plane with disparities that photos have; one in sixteen is arbitrary.
    fn plane(&mut self) -> Plane {
        if self.below(16) == 1 {
            let [a, b, c] = [(); 3].map(|()| f64::from(f32::from_bits(self.word())));
            return Plane { a, b, c };
        }
        let part = |byte: u8| f64::from(byte) / 255.0;
        let [a, b, c] = [(); 3].map(|()| part(self.byte()));
        Plane { a, b: (b - 0.5) / 4.0, c: (c - 0.5) / 4.0 }.quantised()
    }
}

/// Maximum number of pixels of a built container: those of a photo of 640×480.
const MAX_PIXELS: u32 = 640 * 480;

/// A grid with planes and labels for each tile, as the script decides.
pub fn geometry(script: &mut Script, most_planes: u32) -> Geometry {
    let width = script.side(1024);
    let height = script.side(MAX_PIXELS / width).min(MAX_PIXELS / width).max(1);
    let sizes = [64, 64, 64, 32, 16, 8, 80, 33];
    let grid = Grid::new(width, height, sizes[script.below(8) as usize]);
    // the script describes a few tiles; the others repeat them
    let kinds: Vec<(Vec<Plane>, Option<Plane>, [u8; 3])> = (0..=script.below(4))
        .map(|_| {
            let most = if script.below(8) == 1 { most_planes } else { 3 };
            let planes = (0..=script.below(most)).map(|_| script.plane()).collect();
            let background = (script.below(3) == 1).then(|| script.plane());
            (planes, background, [(); 3].map(|()| script.byte()))
        })
        .collect();
    let tile = |t: u32| {
        let r = grid.rect(t);
        let (planes, background, [across, down, noise]) = &kinds[t as usize % kinds.len()];
        let label = |x: u32, y: u32| {
            let cell = x / (u32::from(*across) % 40 + 1) + y / (u32::from(*down) % 40 + 1);
            let stray = u32::from(*noise) > 200 && (x * 31 + y * 17).is_multiple_of(23);
            ((cell + u32::from(stray)) % planes.len() as u32) as u8
        };
        let labels = (r.y..r.y + r.h).flat_map(|y| (r.x..r.x + r.w).map(move |x| (x, y))).map(|(x, y)| label(x, y)).collect();
        Tile { planes: planes.clone(), labels, background: *background }
    };
    let tiles = (0..grid.tiles()).map(tile).collect();
    Geometry {
        grid,
        intrinsics: Intrinsics::centred(width, height, 0.75 * f64::from(width)),
        view_box: ViewBox::cube(0.03),
        tiles,
        matte_band: 0,
    }
}
