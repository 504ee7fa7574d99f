//! Options of a photo as text, with the names and values of the command line's flags.

use std::collections::BTreeMap;

use clap::ValueEnum;

use super::problem::Problem;
use tmpi_core::ViewBox;
use tmpi_pipeline::depth::DepthKind;
use tmpi_pipeline::{Denoise, Options, PlaneCount, PlaneMethod, Stereo, Switch, TileSize};

/// Names of all options.
pub const NAMES: [&str; 15] = [
    "budget-ms",
    "denoise",
    "depth-kind",
    "fov-x",
    "max-error",
    "max-size",
    "photo-depth",
    "plane-method",
    "planes",
    "quality",
    "refine",
    "snap",
    "stereo",
    "tile",
    "view-box",
];

/// Sets option `name` (with `-` or `_`) from text; false if there is no such option.
///
/// # Errors
/// [`Problem`] 400 that names the option and the allowed values.
pub fn set(options: &mut Options, name: &str, value: &str) -> Result<bool, Problem> {
    let name = name.replace('_', "-");
    let value = value.trim();
    match name.as_str() {
        "budget-ms" => options.budget_ms = Some(number(&name, value)?),
        "denoise" => options.denoise = choice::<Denoise>(&name, value)?,
        "depth-kind" => options.depth_kind = choice::<DepthKind>(&name, value)?,
        "fov-x" => options.fov_x = Some(number(&name, value)?),
        "max-error" => options.max_error = number(&name, value)?,
        "max-size" => options.max_size = Some(whole(&name, value, "of pixels")?),
        "photo-depth" => options.photo_depth = choice::<Switch>(&name, value)?,
        "plane-method" => options.plane_method = choice::<PlaneMethod>(&name, value)?,
        "planes" => {
            options.planes =
                if value == "auto" { PlaneCount::Auto } else { PlaneCount::Fixed(whole(&name, value, "from 1 to 64, or auto")?) }
        }
        "quality" => options.quality = whole(&name, value, "from 1 to 100")?,
        "refine" => options.refine = choice::<Switch>(&name, value)?,
        "stereo" => options.stereo = choice::<Stereo>(&name, value)?,
        "snap" => options.snap = choice::<Switch>(&name, value)?,
        "tile" => {
            options.tile = if value == "full" { TileSize::Full } else { TileSize::Pixels(whole(&name, value, "of pixels, or full")?) }
        }
        "view-box" => options.view_box = view_box(&name, value)?,
        _ => return Ok(false),
    }
    Ok(true)
}

/// The view box among options as text; the default if there is none.
pub fn view_box_of(text: &BTreeMap<String, String>) -> ViewBox {
    text.get("view-box").and_then(|v| view_box("view-box", v).ok()).unwrap_or(Options::VIEW_BOX)
}

/// All options as text; [`set`] reads every pair back. Equal options have equal text.
pub fn to_text(options: &Options) -> BTreeMap<String, String> {
    let o = options;
    let planes = match o.planes {
        PlaneCount::Auto => "auto".into(),
        PlaneCount::Fixed(n) => n.to_string(),
    };
    let tile = match o.tile {
        TileSize::Full => "full".into(),
        TileSize::Pixels(n) => n.to_string(),
    };
    let all = [
        ("denoise", value_name(&o.denoise)),
        ("depth-kind", value_name(&o.depth_kind)),
        ("max-error", o.max_error.to_string()),
        ("photo-depth", value_name(&o.photo_depth)),
        ("plane-method", value_name(&o.plane_method)),
        ("planes", planes),
        ("quality", o.quality.to_string()),
        ("refine", value_name(&o.refine)),
        ("snap", value_name(&o.snap)),
        ("stereo", value_name(&o.stereo)),
        ("tile", tile),
        ("view-box", format!("{},{},{}", o.view_box.x, o.view_box.y, o.view_box.z)),
    ];
    let given = [
        ("fov-x", o.fov_x.map(|v| v.to_string())),
        ("budget-ms", o.budget_ms.map(|v| v.to_string())),
        ("max-size", o.max_size.map(|v| v.to_string())),
    ];
    let given = given.into_iter().filter_map(|(name, value)| Some((name, value?)));
    all.into_iter().chain(given).map(|(name, value)| (name.to_owned(), value)).collect()
}

/// The canonical text of [`to_text`] as one string, for hashing.
pub fn canonical(text: &BTreeMap<String, String>) -> String {
    text.iter().fold(String::new(), |s, (k, v)| s + k + "=" + v + "\n")
}

/// Reads what [`to_text`] wrote.
pub fn from_text(text: &BTreeMap<String, String>) -> Result<Options, Problem> {
    let mut options = Options::default();
    for (name, value) in text {
        if !set(&mut options, name, value)? {
            return Err(Problem::parameter(name, "there is no such option"));
        }
    }
    Ok(options)
}

pub fn value_name<T: ValueEnum>(value: &T) -> String {
    value.to_possible_value().map(|v| v.get_name().to_owned()).unwrap_or_default()
}

fn choice<T: ValueEnum>(name: &str, value: &str) -> Result<T, Problem> {
    T::from_str(value, true).map_err(|_| {
        let all: Vec<String> = T::value_variants().iter().map(value_name).collect();
        Problem::parameter(name, format!("must be one of {}, not {value:?}", all.join(", ")))
    })
}

fn number(name: &str, value: &str) -> Result<f64, Problem> {
    match value.parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(v),
        _ => Err(Problem::parameter(name, format!("must be a finite number, not {value:?}"))),
    }
}

/// A whole number; `which` names its kind or range.
fn whole<T: std::str::FromStr>(name: &str, value: &str, which: &str) -> Result<T, Problem> {
    value.parse().map_err(|_| Problem::parameter(name, format!("must be a whole number {which}, not {value:?}")))
}

fn view_box(name: &str, value: &str) -> Result<ViewBox, Problem> {
    let parts: Vec<f64> = value.split(',').map(|part| number(name, part.trim())).collect::<Result<_, _>>()?;
    let &[x, y, z] = parts.as_slice() else {
        return Err(Problem::parameter(name, format!("must be three numbers X,Y,Z, not {value:?}")));
    };
    Ok(ViewBox { x, y, z })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn default_options_read_back_from_text() {
        let text = to_text(&Options::default());
        assert_eq!(from_text(&text).unwrap(), Options::default());
        assert!(text.keys().all(|k| NAMES.contains(&k.as_str())));
        assert_eq!([view_box_of(&text), view_box_of(&BTreeMap::new())], [Options::VIEW_BOX; 2]);
    }

    #[test]
    fn option_names_accept_dashes_and_underscores() {
        for name in NAMES {
            let value = match name {
                "denoise" | "refine" | "snap" | "photo-depth" => "off",
                "depth-kind" => "metric",
                "plane-method" => "lloyd",
                "stereo" => "left-right",
                "view-box" => "0.1, 0.2,0.3",
                _ => "40",
            };
            for spelt in [name.to_owned(), name.replace('-', "_")] {
                let mut o = Options::default();
                assert!(set(&mut o, &spelt, value).unwrap(), "{spelt}");
                assert_ne!(o, Options::default(), "{spelt} changes nothing");
                assert_eq!(from_text(&to_text(&o)).unwrap(), o);
            }
        }
        assert!(!set(&mut Options::default(), "colour", "red").unwrap());
    }

    #[test]
    fn bad_values_name_their_option() {
        for (name, value) in [
            ("denoise", "maybe"),
            ("quality", "256"),
            ("quality", "-1"),
            ("planes", "four"),
            ("planes", "4.5"),
            ("tile", ""),
            ("max-error", "NaN"),
            ("fov-x", "inf"),
            ("view-box", "1,2"),
            ("view-box", "1,2,NaN"),
            ("max-size", "99999999999"),
        ] {
            let p = set(&mut Options::default(), name, value).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(name)), "{name}={value}");
        }
    }

    proptest! {
        #[test]
        fn numbers_keep_every_bit(x in 0.0f64..1.0, q in 1u8..=100, n in 1u32..64) {
            let o = Options { max_error: x, quality: q, planes: PlaneCount::Fixed(n), tile: TileSize::Full, fov_x: Some(x * 100.0), ..Options::default() };
            prop_assert_eq!(from_text(&to_text(&o)).unwrap(), o);
        }
    }
}
