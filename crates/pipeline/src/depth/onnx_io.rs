//! Matches the inputs and outputs of a network's graph with its adapter.

use super::points::shift;
use super::{Adapter, Kind, Outputs};
use crate::networks::{Tensor, TensorInfo};

/// Indices of a graph's inputs and outputs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct OnnxIo {
    /// Number of inputs, and index of the picture among them.
    inputs: usize,
    picture: usize,
    /// The picture has a dimension for several views.
    views: bool,
    /// Index of the input for the number of tokens, and its number of dimensions.
    tokens: Option<(usize, usize)>,
    map: usize,
    sky: Option<usize>,
    scale: Option<usize>,
}

/// A network's map, in the unit of its [`Kind`].
pub(super) struct Values {
    /// One value per pixel.
    pub data: Vec<f32>,
    /// Which pixels are sky; empty if none is.
    pub sky: Vec<bool>,
}

impl OnnxIo {
    /// One picture in, the map as the first output.
    pub(super) const PLAIN: Self = Self { inputs: 1, picture: 0, views: false, tokens: None, map: 0, sky: None, scale: None };

    /// The inputs and outputs that `adapter` describes, and the rows and columns that the picture is fixed to, −1 if any size will do.
    ///
    /// # Errors
    /// A text that says what does not fit.
    pub(super) fn of(adapter: &Adapter, inputs: &[TensorInfo], outputs: &[TensorInfo]) -> Result<(Self, i64, i64), String> {
        let index = |names: &[&str]| names.iter().find_map(|name| outputs.iter().position(|o| o.name == *name));
        let Some(picture) = inputs.iter().position(|p| p.shape.len() >= 4) else {
            let shapes: Vec<_> = inputs.iter().map(|p| format!("{} {:?}", p.name, p.shape)).collect();
            return Err(format!("none of its inputs is a picture: {}", shapes.join(", ")));
        };
        let tokens = inputs.iter().position(|p| p.name == "num_tokens");
        let unknown: Vec<_> =
            inputs.iter().enumerate().filter(|(i, _)| *i != picture && Some(*i) != tokens).map(|(_, p)| p.name.as_str()).collect();
        if !unknown.is_empty() {
            let picture = &inputs[picture].name;
            return Err(format!(
                "besides the picture {picture} it needs {}, which a photo cannot provide: export it without",
                unknown.join(", ")
            ));
        }
        let shape = &inputs[picture].shape;
        let wrong = || format!("its input has dimensions {shape:?}, not those of a picture of three channels");
        let (views, [channels, rows, columns]) = match shape[..] {
            [_, a, b, c] => (1, [a, b, c]),
            [_, views, a, b, c] if adapter.views => (views, [a, b, c]),
            _ => return Err(wrong()),
        };
        if views > 1 {
            return Err(format!("it needs {views} pictures at once: export it for one"));
        }
        if channels != 3 && channels >= 0 {
            return Err(wrong());
        }
        let Outputs { map, sky, scale } = adapter.outputs;
        let map = match index(map) {
            Some(index) => index,
            None if map.is_empty() || outputs.len() == 1 && adapter.output != Kind::Points => 0,
            None => {
                let given: Vec<_> = outputs.iter().map(|o| o.name.as_str()).collect();
                return Err(format!("it returns {}, but none is called {}", given.join(", "), map.join(" or ")));
            }
        };
        let io = Self {
            inputs: inputs.len(),
            picture,
            views: shape.len() == 5,
            tokens: tokens.map(|i| (i, inputs[i].shape.len())),
            map,
            sky: sky.and_then(|s| index(&[s.name])),
            scale: index(scale),
        };
        Ok((io, rows, columns))
    }

    /// All inputs for a picture of `w × h` pixels.
    pub(super) fn inputs(&self, adapter: &Adapter, picture: Vec<f32>, w: usize, h: usize) -> Vec<Tensor> {
        let mut shape = vec![1, 3, h, w];
        if self.views {
            shape.insert(1, 1);
        }
        let mut picture = Some(Tensor { shape, data: picture });
        let multiple = adapter.multiple as usize;
        let tokens = (w / multiple * (h / multiple)).max(1) as f32;
        let input = |i| match self.tokens {
            Some((at, dimensions)) if at == i => Tensor { shape: vec![1; dimensions], data: vec![tokens] },
            _ => picture.take().unwrap_or(Tensor { shape: Vec::new(), data: Vec::new() }),
        };
        (0..self.inputs).map(input).collect()
    }

    /// Picks the map of `w × h` pixels from the outputs.
    ///
    /// # Errors
    /// A text that says what is missing or has another size.
    pub(super) fn values(&self, adapter: &Adapter, mut outputs: Vec<Tensor>, w: usize, h: usize) -> Result<Values, String> {
        let kind = adapter.output;
        let sized = |tensor: &Tensor, each: usize| {
            if tensor.data.len() == each * w * h {
                Ok(())
            } else {
                Err(format!("it returned {:?} for a picture of {w}×{h}", tensor.shape))
            }
        };
        let sky = match (self.sky.and_then(|i| outputs.get(i)), adapter.outputs.sky) {
            (Some(tensor), Some(rule)) => {
                sized(tensor, 1).map_err(|e| format!("{e} as its {}", rule.name))?;
                // NaN is sky by either rule
                let is = |v: f32| v.is_nan() || if rule.inside { v <= rule.threshold } else { v >= rule.threshold };
                tensor.data.iter().map(|&v| is(v)).collect()
            }
            _ => Vec::new(),
        };
        let scale = self.scale.and_then(|i| outputs.get(i)?.data.first().copied()).filter(|s| s.is_finite() && *s > 0.0).unwrap_or(1.0);
        if self.map >= outputs.len() {
            return Err("it returned nothing".into());
        }
        let map = outputs.swap_remove(self.map);
        if kind != Kind::Points {
            sized(&map, 1)?;
            return Ok(Values { data: map.data, sky });
        }
        sized(&map, 3)?;
        let valid: Vec<bool> = if sky.is_empty() { vec![true; w * h] } else { sky.iter().map(|s| !s).collect() };
        let shift = shift(&map.data, &valid, w, h);
        let distance = |z: &f32| ((f64::from(*z) + shift) * f64::from(scale)) as f32;
        Ok(Values { data: map.data.iter().skip(2).step_by(3).map(distance).collect(), sky })
    }
}

#[cfg(test)]
mod tests {
    use super::super::adapter;
    use super::*;

    fn info(name: &str, shape: &[i64]) -> TensorInfo {
        TensorInfo { name: name.into(), shape: shape.to_vec() }
    }

    fn of(name: &str, inputs: &[TensorInfo], outputs: &[&str]) -> Result<(OnnxIo, i64, i64), String> {
        let outputs: Vec<_> = outputs.iter().map(|o| info(o, &[1, -1, -1])).collect();
        OnnxIo::of(adapter(name).unwrap(), inputs, &outputs)
    }

    #[test]
    fn published_interfaces_are_matched() {
        let image = info("image", &[-1, 3, -1, -1]);
        for (tokens, dimensions) in [(info("num_tokens", &[]), 0), (info("num_tokens", &[1]), 1)] {
            let (io, rows, columns) = of("moge-2", &[image.clone(), tokens], &["points", "normal", "mask", "metric_scale"]).unwrap();
            let want = OnnxIo { inputs: 2, tokens: Some((1, dimensions)), sky: Some(2), scale: Some(3), ..OnnxIo::PLAIN };
            assert_eq!((io, rows, columns), (want, -1, -1));
        }
        let (io, rows, columns) = of("moge-2", &[info("image", &[1, 3, 392, 518])], &["points", "mask", "scale"]).unwrap();
        assert_eq!((io, rows, columns), (OnnxIo { sky: Some(1), scale: Some(2), ..OnnxIo::PLAIN }, 392, 518));
        let five = [info("pixel_values", &[-1, -1, 3, -1, -1])];
        let (io, ..) = of("depth-anything-3", &five, &["predicted_depth", "confidence", "extrinsics", "intrinsics"]).unwrap();
        assert_eq!(io, OnnxIo { views: true, ..OnnxIo::PLAIN });
        let (io, rows, columns) = of("depth-anything-3", &[info("image", &[1, 3, 378, 504])], &["sky", "depth"]).unwrap();
        assert_eq!((io, rows, columns), (OnnxIo { map: 1, sky: Some(0), ..OnnxIo::PLAIN }, 378, 504));
        assert_eq!(of("dpt-large", &[info("pixel_values", &[1, 3, 384, 384])], &["what", "ever"]).unwrap().0, OnnxIo::PLAIN);
    }

    #[test]
    fn errors_name_what_does_not_fit() {
        let image = || info("image", &[1, 3, -1, -1]);
        let says = |name, inputs: &[TensorInfo], outputs: &[&str], text: &str| {
            let error = of(name, inputs, outputs).unwrap_err();
            assert!(error.contains(text), "{error}");
        };
        says("depth-anything-3", &[info("image", &[1, 1, 3, 504, 504]), info("intrinsics", &[1, 1, 3, 3])], &["depth"], "needs intrinsics");
        says("depth-anything-3", &[info("image", &[1, 32, 3, 504, 504])], &["depth"], "32 pictures at once");
        says("depth-anything-v2", &[info("image", &[1, 1, 3, 504, 504])], &["depth"], "[1, 1, 3, 504, 504]");
        says("moge-2", &[image()], &["depth", "normal"], "returns depth, normal, but none is called points");
        says("moge-2", &[info("num_tokens", &[])], &["points"], "none of its inputs is a picture");
        says("dpt-large", &[info("image", &[1, 1, 32, 32])], &["depth"], "three channels");
        says("dpt-large", &[], &[], "none of its inputs");
    }

    fn tensor(shape: &[usize], data: Vec<f32>) -> Tensor {
        Tensor { shape: shape.to_vec(), data }
    }

    #[test]
    fn inputs_follow_the_graphs_order() {
        let moge = adapter("moge-2").unwrap();
        let io = OnnxIo { inputs: 2, picture: 1, tokens: Some((0, 0)), ..OnnxIo::PLAIN };
        let inputs = io.inputs(moge, vec![0.5; 3 * 28 * 42], 42, 28);
        assert_eq!((inputs[0].shape.len(), inputs[0].data.as_slice()), (0, [6.0].as_slice()));
        assert_eq!(inputs[1].shape, [1, 3, 28, 42]);
        let five = OnnxIo { views: true, ..OnnxIo::PLAIN }.inputs(moge, vec![0.5; 3 * 28 * 42], 42, 28);
        assert_eq!(five[0].shape, [1, 1, 3, 28, 42]);
    }

    #[test]
    fn sky_and_scale_follow_their_rules() {
        let three = adapter("depth-anything-3").unwrap();
        let io = OnnxIo { map: 1, sky: Some(0), ..OnnxIo::PLAIN };
        let sky = tensor(&[1, 4], vec![0.1, 0.299, 0.3, f32::NAN]);
        let got = io.values(three, vec![sky, tensor(&[1, 4], vec![1.0; 4])], 4, 1).unwrap();
        assert_eq!(got.sky, [false, false, true, true]);
        let moge = adapter("moge-2").unwrap();
        let io = OnnxIo { sky: Some(1), scale: Some(2), ..OnnxIo::PLAIN };
        let points = || tensor(&[1, 1, 2, 3], vec![-1.0, 0.0, 2.0, 1.0, 0.0, 2.0]);
        for (scale, factor) in [(3.0, 3.0), (f32::NAN, 1.0), (0.0, 1.0), (-2.0, 1.0), (f32::INFINITY, 1.0)] {
            let outputs = vec![points(), tensor(&[1, 1, 2], vec![0.5, 0.500_1]), tensor(&[1], vec![scale])];
            let got = io.values(moge, outputs, 2, 1).unwrap();
            // a single point determines no shift
            assert_eq!((got.sky.as_slice(), got.data.as_slice()), ([true, false].as_slice(), [2.0 * factor; 2].as_slice()));
        }
        let none = io.values(moge, vec![points(), tensor(&[1, 1, 2], vec![1.0; 2]), tensor(&[0], vec![])], 2, 1);
        assert!(none.is_ok(), "no scale");
    }

    #[test]
    fn outputs_of_another_size_are_errors() {
        let moge = adapter("moge-2").unwrap();
        let io = OnnxIo { sky: Some(1), ..OnnxIo::PLAIN };
        let says = |outputs: Vec<Tensor>, text: &str| {
            let error = io.values(moge, outputs, 2, 1).err().unwrap();
            assert!(error.contains(text), "{error}");
        };
        let points = || tensor(&[1, 1, 2, 3], vec![1.0; 6]);
        says(vec![], "nothing");
        says(vec![tensor(&[1, 1, 2], vec![1.0; 2]), tensor(&[1, 1, 2], vec![1.0; 2])], "[1, 1, 2] for a picture of 2×1");
        says(vec![points(), tensor(&[1, 0, 0], vec![])], "[1, 0, 0] for a picture of 2×1 as its mask");
        says(vec![points(), tensor(&[1, 1, 2, 3], vec![1.0; 6])], "as its mask");
        says(vec![tensor(&[0], vec![]), tensor(&[1, 1, 2], vec![1.0; 2])], "[0] for a picture");
    }
}
