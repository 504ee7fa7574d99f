//! Colours that tell whether a pixel on the far side of a depth edge belongs to the near side, whose rim it is. Such pixels otherwise stay
//! behind as a dotted contour where the near side moves away.

/// Minimum share of the near side's colour.
const SHARE: f32 = 0.25;
/// Minimum distance between the colours of the two sides, in levels; more similar ones say nothing.
const CONTRAST: f32 = 12.0;

/// Whether a colour has more than a quarter of the step from the far to the near side's. Both are relative to the far side's colour, in
/// levels. False if the step has no direction.
#[inline(always)]
pub fn has_share(colour: [f32; 3], step: [f32; 3]) -> bool {
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let norm = dot(step, step);
    norm > CONTRAST * CONTRAST && dot(colour, step) > SHARE * norm
}

/// The same for chroma alone. Video halves its resolution: the pixels outside of an object have half of its chroma or all of it, and the
/// brightness of the background.
#[inline(always)]
pub fn has_chroma_share(colour: [f32; 3], step: [f32; 3]) -> bool {
    has_share(chroma(colour), chroma(step))
}

/// A colour without its luma, by BT.709.
#[inline(always)]
fn chroma([r, g, b]: [f32; 3]) -> [f32; 3] {
    let luma = 0.2126 * r + 0.7152 * g + 0.0722 * b;
    [r - luma, g - luma, b - luma]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_of_a_clear_step_is_a_share() {
        let step = [60.0, -30.0, 90.0];
        for (share, is) in [(0.2, false), (0.3, true), (1.0, true), (-0.3, false)] {
            assert_eq!(has_share(step.map(|s| share * s), step), is, "{share}");
            assert!(!has_share(step.map(|s| 0.1 * share * s), step.map(|s| 0.1 * s)), "no contrast");
        }
        for bad in [f32::NAN, f32::INFINITY] {
            assert!(!has_share([bad; 3], [bad, -bad, bad]) && !has_share([0.0; 3], [f32::NAN; 3]));
            assert!(!has_chroma_share([bad; 3], step));
        }
    }

    #[test]
    fn chroma_has_a_share_whatever_the_brightness() {
        let step = [120.0, 20.0, -60.0];
        let with = |share: f32, luma: f32| chroma(step).map(|c| share * c + luma);
        for luma in [-80.0, 0.0, 80.0] {
            assert!(has_chroma_share(with(0.5, luma), step) && !has_chroma_share(with(0.1, luma), step), "{luma}");
        }
        assert!(!has_share(with(0.5, -40.0), step), "not the colour");
        assert!(!has_chroma_share([40.0; 3], [90.0; 3]), "grey sides have no chroma");
    }
}
