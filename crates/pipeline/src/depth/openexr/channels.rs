//! Which channel of an OpenEXR file holds depth.

use std::collections::BTreeMap;

use exr::meta::header::Header;

use super::super::DepthError;

/// Most channels of a file. Renderers write some hundreds.
const CHANNELS: usize = 4096;
/// How many channels an error lists.
const LISTED: usize = 12;

/// The channel that holds depth.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Chosen {
    /// Index of its part.
    pub part: usize,
    /// Its index in the part; or those of red, green and blue, in their order in the file, which must be alike.
    pub channels: Vec<usize>,
}

/// The last words of a group's channels, in lower case, with their indices: `z` of `ViewLayer.Depth.Z`.
type Group = BTreeMap<String, usize>;

/// Finds the channel that holds depth. In this order, and the first of several: `Z`, `Depth`, one of a group of that name
/// (`ViewLayer.Depth.Z`, `Depth.V`), `*.Z`, `*.Depth`, `V`, `Y`; else the only channel beside alpha; else red, green and blue, if they are
/// alike. The case of letters does not matter. The name of a part stands for a group.
///
/// # Errors
/// [`DepthError::Map`] lists the channels if there is none, or names the limit.
pub(super) fn choose(headers: &[Header]) -> Result<Chosen, DepthError> {
    let count: usize = headers.iter().map(|header| header.channels.list.len()).sum();
    if count > CHANNELS {
        return Err(DepthError::Map(format!("the OpenEXR file has {count} channels, over the limit of {CHANNELS}")));
    }
    let mut groups = BTreeMap::<(usize, String), Group>::new();
    for (part, header) in headers.iter().enumerate() {
        let of_part = header.own_attributes.layer_name.as_ref().map(|name| name.to_string().to_lowercase()).unwrap_or_default();
        for (index, channel) in header.channels.list.iter().enumerate() {
            let name = channel.name.to_string().to_lowercase();
            let (group, last) = name.rsplit_once('.').unwrap_or((of_part.as_str(), name.as_str()));
            groups.entry((part, group.to_owned())).or_default().insert(last.to_owned(), index);
        }
    }
    let named = |((part, name), group): (&(usize, String), &Group)| {
        let (rank, last) = group.keys().filter_map(|last| Some((rank(name, last, group)?, last))).min()?;
        let all = if last == "r" { colours(group) } else { None };
        Some((rank, *part, all.unwrap_or_else(|| vec![group[last]])))
    };
    if let Some((_, part, channels)) = groups.iter().filter_map(named).min_by_key(|(rank, part, _)| (*rank, *part)) {
        return Ok(Chosen { part, channels });
    }
    let all = groups.iter().flat_map(|((part, _), group)| group.iter().map(move |(last, index)| (*part, last.as_str(), *index)));
    let mut opaque = all.filter(|(_, last, _)| !["a", "alpha"].contains(last));
    if let (Some((part, _, index)), None) = (opaque.next(), opaque.next()) {
        return Ok(Chosen { part, channels: vec![index] });
    }
    let grey = groups.iter().find_map(|((part, _), group)| Some(Chosen { part: *part, channels: colours(group)? }));
    grey.ok_or_else(|| {
        let mut names: Vec<String> = headers.iter().flat_map(|h| h.channels.list.iter().map(|c| c.name.to_string())).collect();
        if names.len() > LISTED {
            names.truncate(LISTED);
            names.push("…".into());
        }
        DepthError::Map(format!("no channel is called Z, Depth, V or Y; it has {}", names.join(", ")))
    })
}

/// Red, green and blue of a group, in their order in the file.
fn colours(group: &Group) -> Option<Vec<usize>> {
    let mut all: Vec<usize> = ["r", "g", "b"].iter().map(|colour| group.get(*colour).copied()).collect::<Option<_>>()?;
    all.sort_unstable();
    Some(all)
}

/// How surely a channel is depth: 0 is most, `None` not at all.
fn rank(group: &str, last: &str, siblings: &Group) -> Option<u8> {
    let has = |other: &str| siblings.contains_key(other);
    match (group.rsplit('.').next().unwrap_or_default(), last) {
        // of positions, normals or motion; of texture coordinates; brightness of a picture in colour
        (_, "z" | "y") if has("x") => None,
        (_, "v") if has("u") => None,
        (_, "y") if has("ry") || has("by") => None,
        ("", "z") => Some(0),
        ("", "depth") => Some(1),
        ("depth" | "z", "z" | "depth" | "v" | "y" | "r") => Some(2),
        (_, "z") => Some(3),
        (_, "depth") => Some(4),
        (_, "v") => Some(5),
        (_, "y") => Some(6),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use exr::meta::attribute::{ChannelDescription, SampleType};

    use super::*;

    fn header(part: &str, channels: &[&str]) -> Header {
        Header::new(part.into(), (4, 3), channels.iter().map(|name| ChannelDescription::named(*name, SampleType::F32)).collect())
    }

    /// The name of the chosen channel of a file with one part, or of the first of three.
    fn chosen<'a>(channels: &[&'a str]) -> Option<&'a str> {
        choose(&[header("", channels)]).ok().map(|chosen| channels[chosen.channels[0]])
    }

    #[test]
    fn depth_is_found_by_the_names_that_renderers_give_it() {
        let cases: [(&[&str], &str); 10] = [
            (&["A", "B", "G", "R", "Z"], "Z"),
            (&["B", "G", "R", "depth"], "depth"),
            (&["Depth.V", "Image.B", "Image.G", "Image.R"], "Depth.V"),
            (&["Layer.Combined.R", "Layer.Denoising Depth.Z", "Layer.Depth.Z", "Layer.Normal.X", "Layer.Normal.Z"], "Layer.Depth.Z"),
            (&["Layer.Mist.Z", "Layer.UV.U", "Layer.UV.V"], "Layer.Mist.Z"),
            (&["beauty.B", "beauty.G", "beauty.R", "depth.R"], "depth.R"),
            (&["V"], "V"),
            (&["A", "Y"], "Y"),
            (&["A", "distance"], "distance"),
            (&["B", "G", "R"], "B"),
        ];
        for (channels, want) in cases {
            assert_eq!(chosen(channels), Some(want), "{channels:?}");
        }
    }

    #[test]
    fn positions_normals_and_colours_are_not_depth() {
        for channels in [&["N.X", "N.Y", "N.Z"][..], &["X", "Y", "Z"], &["BY", "RY", "Y"], &["UV.U", "UV.V"], &["a", "b", "c"]] {
            assert_eq!(chosen(channels), None, "{channels:?}");
        }
        let error = choose(&[header("", &["N.X", "N.Y", "N.Z"])]).unwrap_err().to_string();
        assert!(error.contains("N.X, N.Y, N.Z"), "{error}");
    }

    #[test]
    fn red_green_and_blue_are_chosen_together() {
        assert_eq!(choose(&[header("", &["A", "B", "G", "R"])]).unwrap(), Chosen { part: 0, channels: vec![1, 2, 3] });
        assert_eq!(choose(&[header("", &["C.B", "C.G", "C.R", "Depth.R"])]).unwrap().channels, [3]);
        assert_eq!(choose(&[header("", &["Depth.B", "Depth.G", "Depth.R"])]).unwrap().channels, [0, 1, 2]);
    }

    #[test]
    fn the_name_of_a_part_stands_for_a_group() {
        let parts = [header("Layer.Combined", &["A", "B", "G", "R"]), header("Layer.Depth", &["V"]), header("Other", &["V"])];
        assert_eq!(choose(&parts).unwrap(), Chosen { part: 1, channels: vec![0] });
    }

    #[test]
    fn the_count_of_channels_is_limited() {
        let names: Vec<String> = (0..=CHANNELS).map(|n| format!("c{n}")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let error = |n: usize| choose(&[header("", &names[..n])]).unwrap_err().to_string();
        assert!(error(CHANNELS).contains("it has c0, c1"));
        assert!(error(CHANNELS + 1).contains("4097 channels, over the limit of 4096"));
    }
}
