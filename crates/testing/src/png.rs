//! Writes PNG files of every kind: any depth and kind of colour, interlaced or not, with any chunks.

const GREY: u8 = 0;
const PALETTE: u8 = 3;
/// First column, first row, and steps of both, of the passes of Adam7.
const PASSES: [(usize, usize, usize, usize); 7] =
    [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)];

/// A PNG file as it is to be written.
#[derive(Clone, Debug)]
pub struct Png {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bits a sample: 1, 2, 4, 8, 16.
    pub depth: u8,
    /// Kind of colour: 0 grey, 2 RGB, 3 palette, 4 grey and alpha, 6 RGB and alpha.
    pub colour: u8,
    /// Interlaced by Adam7.
    pub interlaced: bool,
    /// Whole chunks behind the header.
    pub chunks: Vec<Vec<u8>>,
}

impl Png {
    /// The file of the samples that `sample` gives for a channel at a place, 0 to 1; of a palette, which is one of grey, that is the place in it.
    pub fn write(&self, sample: impl Fn(usize, u32, u32) -> f64) -> Vec<u8> {
        let channels = match self.colour {
            GREY | PALETTE => 1,
            4 => 2,
            2 => 3,
            _ => 4,
        };
        let most = f64::from((1u32 << self.depth) - 1);
        let mut rows = Vec::new();
        let passes = if self.interlaced { &PASSES[..] } else { &[(0, 0, 1, 1)] };
        for &(left, top, across, down) in passes {
            let columns: Vec<u32> = (left as u32..self.width).step_by(across).collect();
            if columns.is_empty() {
                continue;
            }
            for y in (top as u32..self.height).step_by(down) {
                rows.push(0);
                let samples = columns.iter().flat_map(|&x| (0..channels).map(move |c| (c, x)));
                let values: Vec<u32> = samples.map(|(c, x)| (sample(c, x, y).clamp(0.0, 1.0) * most).round() as u32).collect();
                rows.extend(self.packed(&values));
            }
        }
        let mut header = [self.width.to_be_bytes(), self.height.to_be_bytes()].concat();
        header.extend([self.depth, self.colour, 0, 0, u8::from(self.interlaced)]);
        let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
        out.extend(chunk(b"IHDR", &header));
        out.extend(self.chunks.concat());
        if self.colour == PALETTE {
            let count = 1u32 << self.depth;
            out.extend(chunk(b"PLTE", &(0..count).flat_map(|i| [(i * 255 / (count - 1)) as u8; 3]).collect::<Vec<_>>()));
        }
        out.extend(chunk(b"IDAT", &zlib(&rows)));
        out.extend(chunk(b"IEND", &[]));
        out
    }

    fn packed(&self, values: &[u32]) -> Vec<u8> {
        match self.depth {
            16 => values.iter().flat_map(|v| (*v as u16).to_be_bytes()).collect(),
            8 => values.iter().map(|v| *v as u8).collect(),
            depth => {
                let pack = |some: &[u32]| {
                    let bits = some.iter().enumerate().fold(0, |byte, (i, v)| byte | v << (8 - u32::from(depth) * (i as u32 + 1)));
                    bits as u8
                };
                values.chunks(usize::from(8 / depth)).map(pack).collect()
            }
        }
    }
}

/// A chunk with its length and checksum.
pub fn chunk(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let named = [name, body].concat();
    let bit = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    let crc = !named.iter().fold(u32::MAX, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| bit(crc)));
    [&(body.len() as u32).to_be_bytes()[..], &named, &crc.to_be_bytes()].concat()
}

/// The chunk of an ICC profile.
pub fn iccp(profile: &[u8]) -> Vec<u8> {
    chunk(b"iCCP", &[b"profile\0\0".as_slice(), &zlib(profile)].concat())
}

/// Bytes as zlib holds them that compresses nothing.
fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut out = vec![0x78, 0x01];
    let blocks = bytes.chunks(65_535).count();
    for (i, block) in bytes.chunks(65_535).enumerate() {
        let length = block.len() as u16;
        out.push(u8::from(i + 1 == blocks));
        out.extend([length.to_le_bytes(), (!length).to_le_bytes()].concat());
        out.extend(block);
    }
    let (a, b) = bytes.iter().fold((1u32, 0u32), |(a, b), &byte| {
        let a = (a + u32::from(byte)) % 65_521;
        (a, (a + b) % 65_521)
    });
    out.extend((b << 16 | a).to_be_bytes());
    out
}
