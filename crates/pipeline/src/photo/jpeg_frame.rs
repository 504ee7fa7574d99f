//! The frame header of a JPEG: size, components, and which coefficients its scans have delivered.

use super::{PhotoError, broken};

/// Colour model of a file's components.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Colour {
    Grey,
    YCbCr,
    Rgb,
    Cmyk,
    Ycck,
}

/// How unusual a file's sampling and scans are. [`super::jpeg_pixels`] has a decoder for each kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layout {
    /// Nearly all files.
    Common,
    /// A component is sampled more finely than the first, or by a factor of three, or has a scan of its own; or the component names spell
    /// RGB although the colours are `YCbCr`.
    Rare,
}

/// Returns true for the markers of frame headers.
pub(super) fn is_frame(marker: u8) -> bool {
    matches!(marker, 0xC0..=0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF)
}

/// A frame header (SOF).
pub(super) struct Frame {
    pub width: u32,
    pub height: u32,
    components: u8,
    pub progressive: bool,
    /// Some scan holds fewer components than the frame.
    one_by_one: bool,
    coefficient_bytes: u64,
    /// Blocks of the picture, without those that only pad the last minimum coded units.
    pub blocks: u64,
    /// Identifiers of the components.
    names: Vec<u8>,
    /// For each component, a bit for each coefficient that no scan has delivered to its last bit yet.
    left: Vec<u64>,
    /// Sampling factors of the components, horizontal and vertical.
    sampling: Vec<(u64, u64)>,
}

impl Frame {
    pub(super) fn read(marker: u8, body: &[u8]) -> Result<Self, PhotoError> {
        if !matches!(marker, 0xC0..=0xC2) {
            return Err(broken("lossless, hierarchical and arithmetic-coded JPEG are not supported"));
        }
        let Some((head, parts)) = body.split_at_checked(6) else { return Err(broken("the frame header is too short")) };
        if head[0] != 8 {
            return Err(PhotoError::Broken(format!("JPEG with {} bits per sample is not supported", head[0])));
        }
        let (height, width) = (u16::from_be_bytes([head[1], head[2]]), u16::from_be_bytes([head[3], head[4]]));
        let components = head[5];
        if !matches!(components, 1 | 3 | 4) || parts.len() < 3 * usize::from(components) {
            return Err(PhotoError::Broken(format!("JPEG with {components} components is not supported")));
        }
        let sampling: Vec<(u64, u64)> =
            parts.chunks_exact(3).take(components.into()).map(|p| (u64::from(p[1] >> 4), u64::from(p[1] & 15))).collect();
        if sampling.iter().any(|&(h, v)| !(1..=4).contains(&h) || !(1..=4).contains(&v)) {
            return Err(broken("invalid sampling factor"));
        }
        let (h_max, v_max) = sampling.iter().fold((1, 1), |m, s| (m.0.max(s.0), m.1.max(s.1)));
        let mcus = u64::from(width).div_ceil(8 * h_max) * u64::from(height).div_ceil(8 * v_max);
        let across = |side: u16, sampling: u64, most: u64| (u64::from(side) * sampling).div_ceil(most).div_ceil(8);
        let blocks = sampling.iter().map(|&(h, v)| across(width, h, h_max) * across(height, v, v_max)).sum();
        // a block has 64 coefficients of 2 bytes
        let coefficient_bytes = sampling.iter().map(|(h, v)| mcus * h * v * 128).sum();
        Ok(Self {
            width: width.into(),
            height: height.into(),
            components,
            progressive: marker == 0xC2,
            one_by_one: false,
            coefficient_bytes,
            blocks,
            names: parts.chunks_exact(3).take(components.into()).map(|p| p[0]).collect(),
            left: vec![u64::MAX; components.into()],
            sampling,
        })
    }

    /// Records what a scan delivers according to its header. Returns the code tables that it uses, as bits like those of [`tables`].
    pub(super) fn refine(&mut self, scan: &[u8]) -> Result<u8, PhotoError> {
        let damaged = || broken("damaged scan header");
        let (&count, rest) = scan.split_first().ok_or_else(damaged)?;
        let (named, spectrum) = rest.split_at_checked(2 * usize::from(count)).ok_or_else(damaged)?;
        let &[first, last, bits, ..] = spectrum else { return Err(damaged()) };
        let (first, last, high, low) = if self.progressive { (first, last, bits >> 4, bits & 15) } else { (0, 63, 0, 0) };
        if count == 0 || first > last || last > 63 || self.is_complete() {
            return Err(damaged());
        }
        self.one_by_one |= count < self.components;
        let brought = (u64::MAX >> (63 - last)) & (u64::MAX << first);
        let (mut uses, mut named_here) = (0, 0u8);
        for (name, numbers) in named.chunks_exact(2).map(|p| (p[0], p[1])) {
            // if components share a name, each mention stands for the next of them
            let place = (0..self.names.len()).find(|&i| self.names[i] == name && named_here & 1 << i == 0).ok_or_else(damaged)?;
            named_here |= 1 << place;
            if low == 0 {
                self.left[place] &= !brought;
            }
            if first == 0 && high == 0 {
                uses |= table(false, numbers >> 4);
            }
            if last > 0 {
                uses |= table(true, numbers & 15);
            }
        }
        Ok(uses)
    }

    /// Memory that decoding takes, in bytes, including the result. A decoder has to keep all coefficients if scans refine the picture or
    /// hold single components.
    pub(super) fn memory(&self) -> u64 {
        let coefficients = if self.progressive || self.one_by_one { self.coefficient_bytes } else { 0 };
        coefficients + u64::from(self.width) * u64::from(self.height) * 3
    }

    pub(super) fn is_complete(&self) -> bool {
        self.left.iter().all(|left| *left == 0)
    }

    /// The colour model, decided as in libjpeg-turbo and therefore in browsers: JFIF first, then Adobe, then component identifiers.
    pub(super) fn colour(&self, jfif: bool, adobe: Option<u8>) -> Colour {
        match (self.components, adobe) {
            (1, _) => Colour::Grey,
            (4, None | Some(0)) => Colour::Cmyk,
            (4, Some(_)) => Colour::Ycck,
            (_, Some(0)) if !jfif => Colour::Rgb,
            (_, None) if !jfif && self.is_named_rgb() => Colour::Rgb,
            _ => Colour::YCbCr,
        }
    }

    fn is_named_rgb(&self) -> bool {
        self.names == *b"RGB"
    }

    pub(super) fn layout(&self, colour: Colour) -> Layout {
        let luma = self.sampling[0];
        let powers = self.sampling.iter().all(|&(h, v)| h.is_power_of_two() && v.is_power_of_two());
        let largest = self.sampling.iter().all(|&(h, v)| h <= luma.0 && v <= luma.1);
        let whole = self.progressive || !self.one_by_one;
        let common = powers && largest && whole && !(colour == Colour::YCbCr && self.is_named_rgb());
        if common { Layout::Common } else { Layout::Rare }
    }
}

/// Code tables that a DHT segment defines, as bits: 0 to 3 for DC, 4 to 7 for AC.
pub(super) fn tables(mut body: &[u8]) -> u8 {
    let mut found = 0;
    while let [kind, rest @ ..] = body {
        let Some((counts, rest)) = rest.split_first_chunk::<16>() else { break };
        found |= table(*kind & 0x10 != 0, kind & 15);
        body = rest.get(counts.iter().map(|&n| usize::from(n)).sum()..).unwrap_or_default();
    }
    found
}

/// The bit of a code table; 0 if its number is out of range.
fn table(ac: bool, number: u8) -> u8 {
    if number < 4 { 1 << (number + if ac { 4 } else { 0 }) } else { 0 }
}
