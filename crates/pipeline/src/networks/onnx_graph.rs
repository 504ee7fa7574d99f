//! Reads from an ONNX file, without ONNX Runtime, what is needed to tell networks apart. Skips weights.

use std::io::{self, BufRead, Seek};

/// Longest description of an input or a node that is read, in bytes.
const LONGEST: u64 = 1 << 16;

/// A graph's picture input, its beginning, and its outputs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OnnxGraph {
    /// Name of the first input with four or five dimensions.
    pub input: String,
    /// Its dimensions; −1 if any size will do.
    pub shape: Vec<i64>,
    /// Names of the outputs.
    pub outputs: Vec<String>,
    /// The graph subtracts or divides before its first convolution: it normalises its input itself.
    pub normalises: bool,
    /// Files of weights outside this one, as it names them.
    pub external_data: Vec<String>,
}

/// Reads the graph of an ONNX file; `None` if it is not one, or has no input of four or five dimensions.
pub fn onnx_graph(file: &mut (impl BufRead + Seek)) -> Option<OnnxGraph> {
    read(file).ok().filter(|o| !o.shape.is_empty())
}

/// A value of the wire format: a number, or the length of what follows.
enum Field {
    Number(u64),
    Bytes(u64),
}

// Field numbers are those of onnx.proto: ModelProto.graph 7; GraphProto.node 1, initializer 5, input 11, output 12; NodeProto.op_type 4; ValueInfoProto.name 1; TensorProto.external_data 13, of StringStringEntryProto.key 1 and value 2
fn read(file: &mut (impl BufRead + Seek)) -> io::Result<OnnxGraph> {
    let (mut found, mut begun) = (OnnxGraph::default(), false);
    while let Some((number, field)) = next(file)? {
        match (number, field) {
            // the graph's fields follow
            (7, Field::Bytes(_)) => break,
            (_, Field::Bytes(length)) => skip(file, length)?,
            _ => {}
        }
    }
    while let Some((number, field)) = next(file)? {
        let Field::Bytes(length) = field else { continue };
        match number {
            1 if !begun && length <= LONGEST => {
                let node = bytes(file, length)?;
                match operator(&node)?.as_deref() {
                    Some("Sub" | "Div") => (begun, found.normalises) = (true, true),
                    Some("Conv") => begun = true,
                    _ => {}
                }
            }
            // weights inside this file are longer, or have no such entry
            5 if length <= LONGEST => {
                found.external_data.extend(location(&bytes(file, length)?).ok().flatten());
            }
            11 if found.shape.is_empty() && length <= LONGEST => {
                if let Some((name, shape)) = input(&bytes(file, length)?)? {
                    (found.input, found.shape) = (name, shape);
                }
            }
            12 if length <= LONGEST => {
                found.outputs.extend(all(&bytes(file, length)?, 1)?.first().map(|name| String::from_utf8_lossy(name).into_owned()));
            }
            _ => skip(file, length)?,
        }
    }
    found.external_data.sort();
    found.external_data.dedup();
    Ok(found)
}

/// The file that holds the numbers of a `TensorProto`, if it names one.
fn location(tensor: &[u8]) -> io::Result<Option<String>> {
    for entry in all(tensor, 13)? {
        if all(entry, 1)?.first() == Some(&b"location".as_slice()) {
            return Ok(all(entry, 2)?.first().map(|name| String::from_utf8_lossy(name).into_owned()));
        }
    }
    Ok(None)
}

/// Name and dimensions of a `ValueInfoProto` whose tensor has four or five dimensions.
fn input(mut port: &[u8]) -> io::Result<Option<(String, Vec<i64>)>> {
    let (mut name, mut shape) = (String::new(), Vec::new());
    while let Some((number, value)) = part(&mut port)? {
        match number {
            1 => name = String::from_utf8_lossy(value).into_owned(),
            // TypeProto.tensor_type 1, Tensor.shape 2, TensorShapeProto.dim 1
            2 => {
                let dims = all(value, 1)?.into_iter().map(|t| all(t, 2)).collect::<io::Result<Vec<_>>>()?.concat();
                for dim in dims.into_iter().map(|s| all(s, 1)).collect::<io::Result<Vec<_>>>()?.concat() {
                    shape.push(dimension(dim)?);
                }
            }
            _ => {}
        }
    }
    Ok(matches!(shape.len(), 4 | 5).then_some((name, shape)))
}

/// `dim_value` (field 1) of a dimension; −1 if it is named or empty.
fn dimension(mut dim: &[u8]) -> io::Result<i64> {
    while let Some((number, field)) = next(&mut dim)? {
        match field {
            Field::Number(value) if number == 1 => return Ok(i64::try_from(value).unwrap_or(-1).max(-1)),
            Field::Bytes(length) => take(&mut dim, length).map(drop)?,
            Field::Number(_) => {}
        }
    }
    Ok(-1)
}

fn operator(node: &[u8]) -> io::Result<Option<String>> {
    Ok(all(node, 4)?.first().map(|name| String::from_utf8_lossy(name).into_owned()))
}

/// All length-delimited values of one field.
fn all(mut message: &[u8], wanted: u64) -> io::Result<Vec<&[u8]>> {
    let mut found = Vec::new();
    while let Some((number, value)) = part(&mut message)? {
        if number == wanted {
            found.push(value);
        }
    }
    Ok(found)
}

/// The next length-delimited field; skips numbers.
fn part<'a>(message: &mut &'a [u8]) -> io::Result<Option<(u64, &'a [u8])>> {
    while let Some((number, field)) = next(message)? {
        if let Field::Bytes(length) = field {
            return Ok(Some((number, take(message, length)?)));
        }
    }
    Ok(None)
}

fn take<'a>(message: &mut &'a [u8], length: u64) -> io::Result<&'a [u8]> {
    let length = usize::try_from(length).ok().filter(|&l| l <= message.len()).ok_or(io::ErrorKind::UnexpectedEof)?;
    let (value, rest) = message.split_at(length);
    *message = rest;
    Ok(value)
}

/// Number and value of the next field, up to but without the bytes of its value; `None` at the end.
fn next(file: &mut impl BufRead) -> io::Result<Option<(u64, Field)>> {
    if file.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let tag = varint(file)?;
    let fixed = |file: &mut dyn BufRead, n: usize| file.read_exact(&mut [0; 8][..n]).map(|()| Field::Number(0));
    let field = match tag & 7 {
        0 => Field::Number(varint(file)?),
        1 => fixed(file, 8)?,
        2 => Field::Bytes(varint(file)?),
        5 => fixed(file, 4)?,
        _ => return Err(io::ErrorKind::InvalidData.into()),
    };
    Ok(Some((tag >> 3, field)))
}

fn varint(file: &mut impl BufRead) -> io::Result<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let mut byte = [0];
        file.read_exact(&mut byte)?;
        value |= u64::from(byte[0] & 0x7F) << shift;
        if byte[0] < 0x80 {
            return Ok(value);
        }
    }
    Err(io::ErrorKind::InvalidData.into())
}

fn bytes(file: &mut impl BufRead, length: u64) -> io::Result<Vec<u8>> {
    let mut all = vec![0; usize::try_from(length).map_err(|_| io::ErrorKind::InvalidData)?];
    file.read_exact(&mut all)?;
    Ok(all)
}

fn skip(file: &mut impl Seek, length: u64) -> io::Result<()> {
    file.seek_relative(i64::try_from(length).map_err(|_| io::ErrorKind::InvalidData)?)
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    const MEAN: &[u8] = include_bytes!("../../../../tests/onnx/mean.onnx");

    #[test]
    fn the_outline_of_a_small_graph_is_read() {
        let got = onnx_graph(&mut Cursor::new(MEAN)).unwrap();
        assert_eq!((got.shape, got.normalises, got.outputs), (vec![1, 3, -1, -1], false, vec!["disparity".to_owned()]));
        assert!(got.external_data.is_empty());
        assert!(!got.input.is_empty());
    }

    /// A length-delimited field.
    fn field(number: u8, value: &[u8]) -> Vec<u8> {
        let length = value.len();
        [&[number << 3 | 2, (length & 0x7F) as u8 | 0x80, (length >> 7) as u8], value].concat()
    }

    #[test]
    fn a_graph_that_normalises_its_input_is_recognised() {
        let dims = [field(1, &[8, 1]), field(1, &[8, 3]), field(1, &[8, 0x80, 3]), field(1, &field(2, b"w"))].concat();
        let port = field(11, &[field(1, b"image"), field(2, &field(1, &[vec![8, 1], field(2, &dims)].concat()))].concat());
        let file = |operators: &[&str]| {
            let nodes =
                operators.iter().flat_map(|name| field(1, &[field(1, b"x"), field(3, b"stem"), field(4, name.as_bytes())].concat()));
            // a version, weights, and fields after the graph
            let graph = [nodes.collect::<Vec<_>>(), field(5, &[7; 300]), port.clone()].concat();
            [vec![8, 7], field(2, b"test"), field(7, &graph), field(8, &[16, 13])].concat()
        };
        let of = |operators: &[&str]| onnx_graph(&mut Cursor::new(file(operators))).unwrap();
        let names = [["Identity"; 100].as_slice(), &["Sub", "Div", "Conv"]].concat();
        let want = OnnxGraph { input: "image".into(), shape: vec![1, 3, 384, -1], normalises: true, ..OnnxGraph::default() };
        assert_eq!(of(&names), want);
        assert!(!of(&["Pad", "Conv", "Sub"]).normalises && !of(&[]).normalises);
    }

    #[test]
    fn several_inputs_outputs_and_files_are_read() {
        let points = onnx_graph(&mut Cursor::new(include_bytes!("../../../../tests/onnx/points.onnx"))).unwrap();
        assert_eq!((points.input.as_str(), points.shape), ("image", vec![1, 3, -1, -1]));
        assert_eq!(points.outputs, ["points", "normal", "mask", "metric_scale"]);
        let views = onnx_graph(&mut Cursor::new(include_bytes!("../../../../tests/onnx/views.onnx"))).unwrap();
        assert_eq!(views.shape, [-1, -1, 3, -1, -1]);
        assert_eq!(
            (views.outputs.as_slice(), views.external_data.as_slice()),
            (["predicted_depth", "confidence"].map(str::to_owned).as_slice(), ["views.onnx_data".to_owned()].as_slice())
        );
    }

    #[test]
    fn other_files_have_no_outline() {
        assert_eq!(onnx_graph(&mut Cursor::new(b"")), None);
        assert_eq!(onnx_graph(&mut Cursor::new(b"[package]\nname = 1")), None);
        assert_eq!(onnx_graph(&mut Cursor::new(include_bytes!("../../../../tests/onnx/sum_difference.onnx"))), None);
    }
}
