//! Writes JPEG files of kinds that other writers do not make: any sampling, any order of scans, any markers.

use std::f64::consts::PI;

/// Step of every quantised coefficient: small, so that what a decoder gives is near to what was written.
const STEP: f64 = 2.0;
/// Sizes of differences of means: code n of four bits stands for size n.
const DC: std::ops::Range<u8> = 0..12;
/// Sizes of other coefficients, of which each with a run is a code of eight bits.
const AC_BITS: u8 = 11;

const ZIGZAG: [usize; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20, 13, 6, 7, 14, 21, 28, 35, 42, 49, 56,
    57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// A component: its identifier and sampling factors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Component {
    /// Identifier in the headers.
    pub id: u8,
    /// Horizontal sampling factor, 1 to 4.
    pub h: u8,
    /// Vertical sampling factor, 1 to 4.
    pub v: u8,
}

/// Components 1, 2, 3 … of these horizontal and vertical sampling factors.
pub fn components(sampling: &[(u8, u8)]) -> Vec<Component> {
    sampling.iter().zip(1..).map(|(&(h, v), id)| Component { id, h, v }).collect()
}

/// A smooth picture: sample 0 to 255 of a component (brightness, two of colour, black) at a place in pixels.
pub fn smooth(component: usize, x: f64, y: f64) -> f64 {
    match component {
        0 => 128.0 + 60.0 * (x / 9.0).sin() + 40.0 * (y / 7.0).cos(),
        1 => 128.0 + 40.0 * (x / 23.0 + y / 31.0).sin(),
        2 => 128.0 + 40.0 * (y / 19.0 - x / 37.0).cos(),
        _ => 200.0 + 30.0 * (x / 20.0).sin(),
    }
}

/// What [`smooth`] looks like as `YCbCr` (BT.601 in full range), in RGB of 0 to 255.
pub fn smooth_rgb(x: f64, y: f64) -> [f64; 3] {
    let [luma, blue, red] = [0, 1, 2].map(|component| smooth(component, x, y));
    let (blue, red) = (blue - 128.0, red - 128.0);
    [luma + 1.402 * red, luma - 0.344_136 * blue - 0.714_136 * red, luma + 1.772 * blue].map(|v| v.clamp(0.0, 255.0))
}

/// The segment that says JFIF.
pub fn jfif() -> (u8, Vec<u8>) {
    (0xE0, b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0".to_vec())
}

/// Adobe's segment, which tells the kind of colours.
pub fn adobe(transform: u8) -> (u8, Vec<u8>) {
    (0xEE, [&b"Adobe\0\x64\0\0\0\0"[..], &[transform]].concat())
}

/// A segment of a file.
pub fn segment(marker: u8, body: &[u8]) -> Vec<u8> {
    [&[0xFF, marker], ((body.len() + 2) as u16).to_be_bytes().as_slice(), body].concat()
}

/// The file with `segments` behind its first marker.
pub fn with_segments(file: &[u8], segments: &[Vec<u8>]) -> Vec<u8> {
    [&file[..2], &segments.concat(), &file[2..]].concat()
}

/// The file with a colour profile.
pub fn with_profile(file: &[u8], profile: &[u8]) -> Vec<u8> {
    with_segments(file, &[segment(0xE2, &[b"ICC_PROFILE\0\x01\x01", profile].concat())])
}

/// The file without its code tables, except those `kept` by class and number. Each table must be a segment of its own.
pub fn without_tables(file: &[u8], kept: &[u8]) -> Vec<u8> {
    let (mut out, mut at) = (file[..2].to_vec(), 2);
    while file[at + 1] != 0xDA {
        let end = at + 2 + usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]]));
        if file[at + 1] != 0xC4 || kept.contains(&file[at + 4]) {
            out.extend(&file[at..end]);
        }
        at = end;
    }
    out.extend(&file[at..]);
    out
}

/// What the entry of a picture says that is one of the eyes of a 3D camera, in [`multi_picture`].
pub const EYE: u32 = 0x0002_0002;

/// A file of several pictures (Multi-Picture Format, CIPA DC-007-2009): `first`, and behind it others, each with the attributes of its entry.
pub fn multi_picture(first: &[u8], behind: &[(u32, &[u8])]) -> Vec<u8> {
    let index = |length: usize| {
        let entry = |attributes: u32, length: usize, at: usize| [attributes, length as u32, at as u32, 0].map(u32::to_be_bytes).concat();
        let bytes = 16 * (behind.len() as u32 + 1);
        let head = [b"MM\0*\0\0\0\x08\0\x01\xB0\x02\0\x07".as_slice(), &bytes.to_be_bytes(), b"\0\0\0\x1A\0\0\0\0"].concat();
        let mut body = [b"MPF\0", head.as_slice(), &entry(0, length, 0)].concat();
        // places count from the byte order on, which lies behind two markers, a length and the name
        let mut at = length.saturating_sub(10);
        for (attributes, picture) in behind {
            body.extend(entry(*attributes, picture.len(), at));
            at += picture.len();
        }
        segment(0xE2, &body)
    };
    let length = first.len() + index(0).len();
    let pictures = behind.iter().flat_map(|(_, picture)| picture.iter().copied());
    with_segments(first, &[index(length)]).into_iter().chain(pictures).collect()
}

/// Order of a file's scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scans {
    /// One scan of all components.
    Interleaved,
    /// One scan for each component.
    Separate,
    /// Progressive: spectral selection and successive approximation.
    Progressive,
}

/// A JPEG file as it is to be written.
#[derive(Clone, Debug)]
pub struct Jpeg {
    /// Width in pixels.
    pub width: u16,
    /// Height in pixels.
    pub height: u16,
    /// Components, at most four.
    pub components: Vec<Component>,
    /// Order of the scans.
    pub scans: Scans,
    /// Minimum coded units between restart markers; 0: none.
    pub restart: u16,
    /// Segments behind the first marker: marker and contents.
    pub segments: Vec<(u8, Vec<u8>)>,
}

impl Jpeg {
    /// An interleaved file without restarts and further segments.
    pub fn new(width: u16, height: u16, components: Vec<Component>) -> Self {
        Self { width, height, components, scans: Scans::Interleaved, restart: 0, segments: Vec::new() }
    }

    /// The file of samples 0 to 255 that `sample` gives for a component at a place of the picture, in pixels.
    pub fn write(&self, sample: impl Fn(usize, f64, f64) -> f64) -> Vec<u8> {
        let planes: Vec<Plane> = (0..self.components.len()).map(|i| self.plane(i, |x, y| sample(i, x, y))).collect();
        let mut out = vec![0xFF, 0xD8];
        for (marker, body) in &self.segments {
            out.extend(segment(*marker, body));
        }
        out.extend(segment(0xDB, &[&[0][..], &[STEP as u8; 64]].concat()));
        let mut frame = vec![8];
        frame.extend([self.height.to_be_bytes(), self.width.to_be_bytes()].concat());
        frame.push(self.components.len() as u8);
        frame.extend(self.components.iter().flat_map(|c| [c.id, c.h << 4 | c.v, 0]));
        out.extend(segment(if self.scans == Scans::Progressive { 0xC2 } else { 0xC0 }, &frame));
        let table = |class: u8, bits: usize, values: Vec<u8>| {
            let mut counts = [0; 16];
            counts[bits - 1] = values.len() as u8;
            [&[class << 4][..], &counts, &values].concat()
        };
        let ac = (0..16).flat_map(|run| (0..AC_BITS).map(move |bits| run << 4 | bits)).collect();
        out.extend(segment(0xC4, &[table(0, 4, DC.collect()), table(1, 8, ac)].concat()));
        if self.restart > 0 {
            out.extend(segment(0xDD, &self.restart.to_be_bytes()));
        }
        self.scans(&planes, &mut out);
        out.extend([0xFF, 0xD9]);
        out
    }

    fn scans(&self, planes: &[Plane], out: &mut Vec<u8>) {
        let all: Vec<usize> = (0..planes.len()).collect();
        let each = |band: Band| all.iter().map(move |&i| (vec![i], band));
        let scans: Vec<(Vec<usize>, Band)> = match self.scans {
            Scans::Interleaved => vec![(all.clone(), Band::WHOLE)],
            Scans::Separate => each(Band::WHOLE).collect(),
            Scans::Progressive => {
                let band = |first, last, high, low| Band { first, last, high, low };
                let dc = |high, low| [(all.clone(), band(0, 0, high, low))].into_iter();
                dc(0, 1)
                    .chain(each(band(1, 5, 0, 1)))
                    .chain(each(band(6, 63, 0, 1)))
                    .chain(dc(1, 0))
                    .chain(each(band(1, 63, 1, 0)))
                    .collect()
            }
        };
        for (of, band) in scans {
            let mut head = vec![of.len() as u8];
            head.extend(of.iter().flat_map(|&i| [self.components[i].id, 0]));
            head.extend([band.first, band.last, band.high << 4 | band.low]);
            out.extend(segment(0xDA, &head));
            self.scan(planes, &of, band, out);
        }
    }

    /// The entropy-coded data of a scan.
    fn scan(&self, planes: &[Plane], of: &[usize], band: Band, out: &mut Vec<u8>) {
        let (h_max, v_max) = self.most();
        let units = |side: u16, most: u8| usize::from(side).div_ceil(8 * usize::from(most));
        // blocks across and down of a unit for each component, and units across and down
        let (blocks, across, down): (Vec<(usize, usize)>, usize, usize) = if let [one] = of {
            (vec![(1, 1)], planes[*one].across, planes[*one].down)
        } else {
            let blocks = of.iter().map(|&i| (self.components[i].h.into(), self.components[i].v.into())).collect();
            (blocks, units(self.width, h_max), units(self.height, v_max))
        };
        let mut bits = Bits::default();
        let mut before = vec![0; of.len()];
        for unit in 0..across * down {
            if self.restart > 0 && unit > 0 && unit % usize::from(self.restart) == 0 {
                let number = unit / usize::from(self.restart) - 1;
                bits.flush();
                bits.bytes.extend([0xFF, 0xD0 + (number % 8) as u8]);
                before.fill(0);
            }
            for (place, (&i, &(w, h))) in of.iter().zip(&blocks).enumerate() {
                for (v, u) in (0..h).flat_map(|v| (0..w).map(move |u| (v, u))) {
                    let block = planes[i].block(unit % across * w + u, unit / across * h + v);
                    band.code(block, &mut before[place], &mut bits);
                }
            }
        }
        bits.flush();
        out.extend(bits.bytes);
    }

    fn most(&self) -> (u8, u8) {
        self.components.iter().fold((1, 1), |m, c| (m.0.max(c.h), m.1.max(c.v)))
    }

    fn plane(&self, i: usize, sample: impl Fn(f64, f64) -> f64) -> Plane {
        let (h_max, v_max) = self.most();
        let (h, v) = (self.components[i].h, self.components[i].v);
        let side = |pixels: u16, of: u8, most: u8| (usize::from(pixels) * usize::from(of)).div_ceil(most.into());
        let (width, height) = (side(self.width, h, h_max), side(self.height, v, v_max));
        let (step_x, step_y) = (f64::from(h_max) / f64::from(h), f64::from(v_max) / f64::from(v));
        let (across, down) = (width.div_ceil(8), height.div_ceil(8));
        let at = |x: usize, y: usize| sample((x.min(width - 1) as f64 + 0.5) * step_x, (y.min(height - 1) as f64 + 0.5) * step_y) - 128.0;
        let block = |n: usize| transformed(|x, y| at(n % across * 8 + x, n / across * 8 + y));
        Plane { across, down, blocks: (0..across * down).map(block).collect() }
    }
}

/// Quantised coefficients in zigzag order.
type Block = [i32; 64];

struct Plane {
    /// Blocks across and down that hold samples.
    across: usize,
    down: usize,
    blocks: Vec<Block>,
}

impl Plane {
    /// A block; beyond the picture the last one is repeated, as far as its mean goes.
    fn block(&self, x: usize, y: usize) -> Block {
        let inside = x < self.across && y < self.down;
        let block = self.blocks[y.min(self.down - 1) * self.across + x.min(self.across - 1)];
        if inside { block } else { std::array::from_fn(|k| if k == 0 { block[0] } else { 0 }) }
    }
}

/// The discrete cosine transform of a block, by its definition.
fn transformed(at: impl Fn(usize, usize) -> f64) -> Block {
    let samples: [f64; 64] = std::array::from_fn(|i| at(i % 8, i / 8));
    let basis = |x: usize, u: usize| ((2 * x + 1) as f64 * u as f64 * PI / 16.0).cos() * if u == 0 { 0.5f64.sqrt() } else { 1.0 } / 2.0;
    let cosines: [[f64; 8]; 8] = std::array::from_fn(|u| std::array::from_fn(|x| basis(x, u)));
    std::array::from_fn(|k| {
        let (u, v) = (ZIGZAG[k] % 8, ZIGZAG[k] / 8);
        let sum: f64 = samples.iter().enumerate().map(|(i, s)| s * cosines[u][i % 8] * cosines[v][i / 8]).sum();
        (sum / STEP).round() as i32
    })
}

/// The coefficients, and the bits of them, that a scan brings.
#[derive(Clone, Copy)]
struct Band {
    first: u8,
    last: u8,
    /// Bits that were left out by the scan before; 0: there was none.
    high: u8,
    /// Bits that are left out.
    low: u8,
}

impl Band {
    const WHOLE: Self = Self { first: 0, last: 63, high: 0, low: 0 };

    fn code(self, block: Block, before: &mut i32, bits: &mut Bits) {
        if self.first == 0 {
            if self.high > 0 {
                bits.put((block[0] >> self.low & 1) as u32, 1);
            } else {
                let mean = block[0] >> self.low;
                let difference = mean - std::mem::replace(before, mean);
                let size = size(difference);
                bits.put(size, 4);
                bits.value(difference, size);
            }
        }
        if self.last > 0 {
            let first = usize::from(self.first.max(1));
            if self.high > 0 { self.refine(block, first, bits) } else { self.begin(block, first, bits) }
        }
    }

    /// Coefficients of which nothing was said yet.
    fn begin(self, block: Block, first: usize, bits: &mut Bits) {
        let mut run = 0;
        for &value in &block[first..=self.last.into()] {
            let value = value.signum() * (value.abs() >> self.low);
            if value == 0 {
                run += 1;
                continue;
            }
            bits.zeros(&mut run);
            bits.ac(run, size(value));
            bits.value(value, size(value));
            run = 0;
        }
        if run > 0 {
            bits.ac(0, 0);
        }
    }

    /// One more bit of each coefficient.
    fn refine(self, block: Block, first: usize, bits: &mut Bits) {
        let known: Vec<i32> = block.iter().map(|v| v.abs() >> self.low).collect();
        let end = known.iter().rposition(|&v| v == 1).unwrap_or(0);
        let (mut run, mut corrections) = (0, Vec::new());
        for k in first..=self.last.into() {
            if known[k] == 0 {
                run += 1;
                continue;
            }
            while run > 15 && k <= end {
                bits.ac(15, 0);
                corrections.drain(..).for_each(|bit| bits.put(bit, 1));
                run -= 16;
            }
            if known[k] > 1 {
                corrections.push((known[k] & 1) as u32);
                continue;
            }
            bits.ac(run, 1);
            bits.put(u32::from(block[k] > 0), 1);
            corrections.drain(..).for_each(|bit| bits.put(bit, 1));
            run = 0;
        }
        if run > 0 || !corrections.is_empty() {
            bits.ac(0, 0);
            corrections.drain(..).for_each(|bit| bits.put(bit, 1));
        }
    }
}

/// Bits of a value's magnitude.
fn size(value: i32) -> u32 {
    32 - value.unsigned_abs().leading_zeros()
}

/// Bits on their way to bytes.
#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    held: u32,
    count: u32,
}

impl Bits {
    fn put(&mut self, bits: u32, count: u32) {
        for i in (0..count).rev() {
            self.held = self.held << 1 | bits >> i & 1;
            self.count += 1;
            if self.count == 8 {
                self.bytes.push(self.held as u8);
                if self.held as u8 == 0xFF {
                    self.bytes.push(0);
                }
                (self.held, self.count) = (0, 0);
            }
        }
    }

    /// The place of a value among those of its size.
    fn value(&mut self, value: i32, size: u32) {
        self.put(if value < 0 { (value - 1) as u32 } else { value as u32 }, size);
    }

    /// A run of zeros and the size of the coefficient behind them.
    fn ac(&mut self, run: u32, size: u32) {
        self.put(run * u32::from(AC_BITS) + size, 8);
    }

    fn zeros(&mut self, run: &mut u32) {
        while *run > 15 {
            self.ac(15, 0);
            *run -= 16;
        }
    }

    fn flush(&mut self) {
        while self.count > 0 {
            self.put(1, 1);
        }
    }
}
