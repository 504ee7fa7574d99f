//! The frame of a JPEG: size, components, and what its scans bring of them.

use super::PhotoError;
use super::segments::broken;

/// What the components of a file are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Colour {
    Grey,
    YCbCr,
    Rgb,
    Cmyk,
    Ycck,
}

/// How samples and scans of a file lie. [`super::jpeg_pixels`] has a decoder for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layout {
    /// As in nearly all files.
    Common,
    /// A component is sampled finer than the first, or three times, or comes in a scan of its own; or the names of components say RGB
    /// where they are not.
    Rare,
}

/// True for the markers of frame headers.
pub(super) fn is_frame(marker: u8) -> bool {
    matches!(marker, 0xC0..=0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF)
}

/// Start of frame.
pub(super) struct Frame {
    pub width: u32,
    pub height: u32,
    components: u8,
    pub progressive: bool,
    /// A scan holds fewer components than the frame.
    pub one_by_one: bool,
    pub coefficient_bytes: u64,
    /// Blocks of the picture alone, without those that only fill up the last minimum coded units.
    pub blocks: u64,
    /// Names of the components.
    names: Vec<u8>,
    /// Coefficients, as bits, of each component that no scan has brought to their last bit.
    left: Vec<u64>,
    /// Sampling factors of the components, horizontal and vertical.
    sampling: Vec<(u64, u64)>,
}

impl Frame {
    pub(super) fn read(marker: u8, body: &[u8]) -> Result<Self, PhotoError> {
        if !matches!(marker, 0xC0..=0xC2) {
            return Err(broken("lossless, hierarchical and arithmetic-coded JPEG are not read"));
        }
        let Some((head, parts)) = body.split_at_checked(6) else { return Err(broken("a short frame header")) };
        if head[0] != 8 {
            return Err(PhotoError::Broken(format!("JPEG of {} bits a sample is not read", head[0])));
        }
        let (height, width) = (u16::from_be_bytes([head[1], head[2]]), u16::from_be_bytes([head[3], head[4]]));
        let components = head[5];
        if !matches!(components, 1 | 3 | 4) || parts.len() < 3 * usize::from(components) {
            return Err(PhotoError::Broken(format!("JPEG of {components} components is not read")));
        }
        let sampling: Vec<(u64, u64)> =
            parts.chunks_exact(3).take(components.into()).map(|p| (u64::from(p[1] >> 4), u64::from(p[1] & 15))).collect();
        if sampling.iter().any(|&(h, v)| !(1..=4).contains(&h) || !(1..=4).contains(&v)) {
            return Err(broken("an impossible sampling factor"));
        }
        let (h_max, v_max) = sampling.iter().fold((1, 1), |m, s| (m.0.max(s.0), m.1.max(s.1)));
        let mcus = u64::from(width).div_ceil(8 * h_max) * u64::from(height).div_ceil(8 * v_max);
        let across = |side: u16, sampling: u64, most: u64| (u64::from(side) * sampling).div_ceil(most).div_ceil(8);
        let blocks = sampling.iter().map(|&(h, v)| across(width, h, h_max) * across(height, v, v_max)).sum();
        // 64 coefficients of 2 bytes a block
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

    /// Notes what a scan brings, by its header, and gives the code tables that it uses.
    pub(super) fn refine(&mut self, scan: &[u8]) -> Result<u8, PhotoError> {
        let damaged = || broken("a damaged scan header");
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
            // of several with one name each is named in its turn
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

    pub(super) fn is_complete(&self) -> bool {
        self.left.iter().all(|left| *left == 0)
    }

    /// What its components are, as libjpeg-turbo and with it the browsers have it: JFIF before Adobe before identifiers.
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

/// Code tables that a segment brings: a bit for each of DC, then of AC.
pub(super) fn tables(mut body: &[u8]) -> u8 {
    let mut found = 0;
    while let [kind, rest @ ..] = body {
        let Some((counts, rest)) = rest.split_first_chunk::<16>() else { break };
        found |= table(*kind & 0x10 != 0, kind & 15);
        body = rest.get(counts.iter().map(|&n| usize::from(n)).sum()..).unwrap_or_default();
    }
    found
}

/// The bit of a code table; none for a number that there is not.
fn table(ac: bool, number: u8) -> u8 {
    if number < 4 { 1 << (number + if ac { 4 } else { 0 }) } else { 0 }
}
