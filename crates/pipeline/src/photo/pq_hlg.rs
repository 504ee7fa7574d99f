//! Converts high-dynamic-range colours, PQ and HLG of ITU-R BT.2100, to sRGB.
//!
//! A standard-range screen shows its white at [`WHITE`] nits; these pictures reach [`PEAK`]. The conversion is that of browsers: the
//! reference white tone mapping operator of SMPTE ST 2094-50 halves everything up to reference white and bends brighter light towards the
//! screen's white.

use moxcms::{CicpProfile, ColorProfile, TransferCharacteristics};

/// Reference white in nits.
const WHITE: f64 = 203.0;
/// Peak in nits of a picture that does not declare one.
const PEAK: f64 = 1000.0;
/// The peak in units of reference white.
const MOST: f64 = PEAK / WHITE;
/// Where the curve maps reference white.
const KNEE: f64 = 0.5;
/// Where the middle control point of the curve above reference white lies between its ends.
const KAPPA: f64 = 0.65;
/// Largest 16-bit sample.
const MAX: f64 = u16::MAX as f64;
/// Weights of the BT.2020 primaries in luminance.
const LUMINANCE: [f64; 3] = [0.2627, 0.6780, 0.0593];

type Matrix = [[f64; 3]; 3];

/// Converts pixels with 16-bit samples.
pub(super) struct Hdr {
    /// Light by sample: for PQ display light in units of reference white, for HLG scene light 0 to 1.
    light: Vec<f64>,
    hlg: bool,
    /// From the picture's primaries to those of BT.2020, in which tone mapping happens.
    to_bt2020: Matrix,
    to_srgb: Matrix,
    /// sRGB samples for light 0 to 1 in 65 536 even steps.
    encoded: Vec<u16>,
}

impl Hdr {
    /// Returns `None` if the transfer function is of standard range.
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

    /// Converts one pixel to sRGB.
    pub(super) fn convert(&self, pixel: [u16; 3]) -> [u16; 3] {
        let mut light = times(&self.to_bt2020, pixel.map(|v| self.light[usize::from(v)])).map(|v| v.max(0.0));
        if self.hlg {
            // HLG's system gamma of 1.2: the display brightens what is bright
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

/// Gain for light whose brightest channel is `x`, in units of reference white.
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

/// Display light of a PQ sample 0 to 1, in units of reference white (SMPTE ST 2084).
fn pq_light(value: f64) -> f64 {
    let (m1, m2) = (2610.0 / 16_384.0, 2523.0 / 32.0);
    let (c1, c2, c3) = (3424.0 / 4096.0, 2413.0 / 128.0, 2392.0 / 128.0);
    let root = value.powf(1.0 / m2);
    10_000.0 / WHITE * ((root - c1).max(0.0) / (c2 - c3 * root)).powf(1.0 / m1)
}

/// Scene light, 0 to 1, of an HLG sample 0 to 1 (ITU-R BT.2100, table 5).
fn hlg_light(value: f64) -> f64 {
    let (a, b, c) = (0.178_832_77, 0.284_668_92, 0.559_910_73);
    if value <= 0.5 { value * value / 3.0 } else { (((value - c) / a).exp() + b) / 12.0 }
}

/// sRGB encoding of linear light 0 to 1.
fn srgb(light: f64) -> f64 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}
