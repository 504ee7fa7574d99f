//! Colours of high dynamic range, PQ and HLG of ITU-R BT.2100, to sRGB.
//!
//! A screen of standard range shows its white at [`WHITE`] nits, and these reach to [`PEAK`]. What browsers do is done here: the reference
//! white tone mapping operator of SMPTE ST 2094-50, by which everything up to reference white is halved and what is brighter bends
//! towards the screen's white.

use std::sync::Arc;

use moxcms::{
    CicpProfile, CmsError, ColorProfile, Layout, ToneReprCurve, TransferCharacteristics, Transform16BitExecutor, TransformOptions,
};

/// Nits of reference white and of the brightest that a picture has where it does not say.
const WHITE: f64 = 203.0;
const PEAK: f64 = 1000.0;
/// The brightest, in units of reference white.
const MOST: f64 = PEAK / WHITE;
/// What reference white becomes, and where between its ends the curve above it bends.
const KNEE: f64 = 0.5;
const KAPPA: f64 = 0.65;
/// Share of the primaries of BT.2020 in luminance.
const LUMINANCE: [f64; 3] = [0.2627, 0.6780, 0.0593];

/// The conversion of pixels with samples of 16 bits.
pub(super) struct Hdr {
    /// What a sample stands for: light of the screen in units of reference white, or of HLG light of the scene, 0 to 1.
    light: Vec<f64>,
    hlg: bool,
    /// From the picture's primaries to those of BT.2020, in which light is mapped.
    primaries: [[f64; 3]; 3],
    to_srgb: Arc<Transform16BitExecutor>,
}

impl Hdr {
    /// None where the transfer function is of standard range.
    pub(super) fn of(cicp: CicpProfile) -> Option<Self> {
        let hlg = match cicp.transfer_characteristics {
            TransferCharacteristics::Smpte2084 => false,
            TransferCharacteristics::Hlg => true,
            _ => return None,
        };
        let light = (0..=u16::MAX).map(|v| f64::from(v) / f64::from(u16::MAX)).map(if hlg { hlg_light } else { pq_light }).collect();
        let mapped = linear_bt2020();
        let primaries = ColorProfile::new_from_cicp(cicp).transform_matrix(&mapped).v;
        Some(Self { light, hlg, primaries, to_srgb: to_srgb(&mapped).ok()? })
    }

    /// Converts pixels in place; they stay as they are where that fails.
    pub(super) fn convert(&self, pixels: &mut [[u16; 3]]) {
        let light: Vec<[u16; 3]> = pixels.iter().map(|p| self.mapped(*p)).collect();
        // it fails on lengths that do not agree
        let _ = self.to_srgb.transform(light.as_flattened(), pixels.as_flattened_mut());
    }

    /// Light of a screen of standard range, by the primaries of BT.2020.
    fn mapped(&self, pixel: [u16; 3]) -> [u16; 3] {
        let light = pixel.map(|v| self.light[usize::from(v)]);
        let dot = |row: &[f64; 3], v: &[f64; 3]| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
        let mut light = [0, 1, 2].map(|i| dot(&self.primaries[i], &light).max(0.0));
        if self.hlg {
            // the screen's own curve makes what is bright brighter
            let gain = dot(&LUMINANCE, &light).powf(0.2) * MOST;
            light = light.map(|v| v * gain);
        }
        let gain = gain(light.into_iter().fold(0.0, f64::max));
        light.map(|v| (v * gain).mul_add(f64::from(u16::MAX), 0.5).min(f64::from(u16::MAX)) as u16)
    }
}

/// By how much light is multiplied whose brightest channel is `x`.
fn gain(x: f64) -> f64 {
    if x <= 1.0 {
        return KNEE;
    }
    // a quadratic Bézier curve from (1, KNEE) to (MOST, 1)
    let middle = |knee: f64, end: f64| (1.0 - KAPPA) * knee + KAPPA * end;
    let (x_mid, y_mid) = (middle(1.0, 1.0 / KNEE), middle(KNEE, 1.0));
    let x = x.min(MOST);
    let (a, b) = (1.0 - 2.0 * x_mid + MOST, 2.0 * (x_mid - 1.0));
    let t = ((b * b - 4.0 * a * (1.0 - x)).sqrt() - b) / (2.0 * a);
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

/// BT.2020 with samples that are light.
fn linear_bt2020() -> ColorProfile {
    let mut profile = ColorProfile::new_bt2020();
    for curve in [&mut profile.red_trc, &mut profile.green_trc, &mut profile.blue_trc] {
        *curve = Some(ToneReprCurve::Lut(vec![]));
    }
    profile.cicp = None;
    profile
}

fn to_srgb(light: &ColorProfile) -> Result<Arc<Transform16BitExecutor>, CmsError> {
    light.create_transform_16bit(Layout::Rgb, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default())
}
