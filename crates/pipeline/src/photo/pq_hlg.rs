//! Colours of high dynamic range, PQ and HLG of ITU-R BT.2100, to sRGB.
//!
//! A screen of standard range shows its white at [`WHITE`] nits, and these reach to [`PEAK`]. What browsers do is done here: the reference
//! white tone mapping operator of SMPTE ST 2094-50, by which everything up to reference white is halved and what is brighter bends
//! towards the screen's white.

use moxcms::{CicpProfile, ColorProfile, TransferCharacteristics};

/// Nits of reference white and of the brightest that a picture has where it does not say.
const WHITE: f64 = 203.0;
const PEAK: f64 = 1000.0;
/// The brightest, in units of reference white.
const MOST: f64 = PEAK / WHITE;
/// What reference white becomes, and where between its ends the curve above it bends.
const KNEE: f64 = 0.5;
const KAPPA: f64 = 0.65;
/// The largest sample.
const MAX: f64 = u16::MAX as f64;
/// Share of the primaries of BT.2020 in luminance.
const LUMINANCE: [f64; 3] = [0.2627, 0.6780, 0.0593];

type Matrix = [[f64; 3]; 3];

/// The conversion of pixels with samples of 16 bits.
pub(super) struct Hdr {
    /// What a sample stands for: light of the screen in units of reference white, or of HLG light of the scene, 0 to 1.
    light: Vec<f64>,
    hlg: bool,
    /// From the picture's primaries to those of BT.2020, in which light is mapped.
    to_bt2020: Matrix,
    to_srgb: Matrix,
    /// sRGB's sample for light 0 to 1, of which each of the table is one of 65 536 even steps.
    encoded: Vec<u16>,
}

impl Hdr {
    /// None where the transfer function is of standard range.
    pub(super) fn of(cicp: CicpProfile) -> Option<Self> {
        let hlg = match cicp.transfer_characteristics {
            TransferCharacteristics::Smpte2084 => false,
            TransferCharacteristics::Hlg => true,
            _ => return None,
        };
        let steps = || (0..=u16::MAX).map(|v| f64::from(v) / MAX);
        let bt2020 = ColorProfile::new_bt2020();
        Some(Self {
            light: steps().map(if hlg { hlg_light } else { pq_light }).collect(),
            hlg,
            to_bt2020: ColorProfile::new_from_cicp(cicp).transform_matrix(&bt2020).v,
            to_srgb: bt2020.transform_matrix(&ColorProfile::new_srgb()).v,
            encoded: steps().map(|light| (MAX * srgb(light)).round() as u16).collect(),
        })
    }

    /// Converts a pixel.
    pub(super) fn convert(&self, pixel: [u16; 3]) -> [u16; 3] {
        let mut light = times(&self.to_bt2020, pixel.map(|v| self.light[usize::from(v)])).map(|v| v.max(0.0));
        if self.hlg {
            // the screen's own curve makes what is bright brighter
            let luminance: f64 = LUMINANCE.iter().zip(light).map(|(share, v)| share * v).sum();
            light = light.map(|v| v * luminance.powf(0.2) * MOST);
        }
        let gain = gain(light.into_iter().fold(0.0, f64::max));
        times(&self.to_srgb, light.map(|v| v * gain)).map(|v| self.encoded[(v.clamp(0.0, 1.0) * MAX).round() as usize])
    }
}

fn times(matrix: &Matrix, [r, g, b]: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row[0] * r + row[1] * g + row[2] * b)
}

/// By how much light is multiplied whose brightest channel is `x`.
fn gain(x: f64) -> f64 {
    if x <= 1.0 {
        return KNEE;
    }
    // a quadratic Bézier curve from (1, KNEE) to (MOST, 1)
    let middle = |knee: f64, end: f64| (1.0 - KAPPA) * knee + KAPPA * end;
    let (x_mid, y_mid) = (middle(1.0, 1.0 / KNEE), middle(KNEE, 1.0));
    let (a, b) = (1.0 - 2.0 * x_mid + MOST, 2.0 * (x_mid - 1.0));
    let t = ((b * b - 4.0 * a * (1.0 - x.min(MOST))).sqrt() - b) / (2.0 * a);
    let y = (KNEE - 2.0 * y_mid + 1.0) * t * t + 2.0 * (y_mid - KNEE) * t + KNEE;
    y / x
}

/// Light of the screen in units of reference white (SMPTE ST 2084).
fn pq_light(value: f64) -> f64 {
    let (m1, m2) = (2610.0 / 16_384.0, 2523.0 / 32.0);
    let (c1, c2, c3) = (3424.0 / 4096.0, 2413.0 / 128.0, 2392.0 / 128.0);
    let root = value.powf(1.0 / m2);
    10_000.0 / WHITE * ((root - c1).max(0.0) / (c2 - c3 * root)).powf(1.0 / m1)
}

/// Light of the scene, 0 to 1 (ITU-R BT.2100, table 5).
fn hlg_light(value: f64) -> f64 {
    let (a, b, c) = (0.178_832_77, 0.284_668_92, 0.559_910_73);
    if value <= 0.5 { value * value / 3.0 } else { (((value - c) / a).exp() + b) / 12.0 }
}

/// sRGB's encoding of light 0 to 1.
fn srgb(light: f64) -> f64 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}
