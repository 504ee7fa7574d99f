//! What an ONNX file says of its graph before ONNX Runtime sees it: enough to tell networks apart. Weights are passed over.

use std::io::{self, BufRead, Seek};

/// Longest description of an input or a node that is read, in bytes.
const LONGEST: u64 = 1 << 16;

/// The picture input of a graph, and how the graph begins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outline {
    /// Name of the first input with four extents.
    pub input: String,
    /// Its extents; −1 where any extent will do.
    pub shape: [i64; 4],
    /// The graph subtracts or divides before its first convolution: it normalises by itself.
    pub normalises: bool,
}

/// Reads the outline of an ONNX file; none where it is not one, or has no input of four extents.
#[must_use]
pub fn outline(file: &mut (impl BufRead + Seek)) -> Option<Outline> {
    read(file).ok().flatten()
}

/// A value of the wire format: a number, or the length of what follows.
enum Field {
    Number(u64),
    Bytes(u64),
}

// Field numbers are those of onnx.proto: ModelProto.graph 7; GraphProto.node 1, input 11; NodeProto.op_type 4
fn read(file: &mut (impl BufRead + Seek)) -> io::Result<Option<Outline>> {
    let (mut port, mut normalises) = (None, None);
    while let Some((number, field)) = next(file)? {
        match (number, field) {
            // The graph's fields follow
            (7, Field::Bytes(_)) => break,
            (_, Field::Bytes(length)) => skip(file, length)?,
            _ => {}
        }
    }
    while let Some((number, field)) = next(file)? {
        let Field::Bytes(length) = field else { continue };
        match number {
            1 if normalises.is_none() && length <= LONGEST => {
                normalises = match operator(&bytes(file, length)?)?.as_deref() {
                    Some("Sub" | "Div") => Some(true),
                    Some("Conv") => Some(false),
                    _ => None,
                };
            }
            11 if port.is_none() && length <= LONGEST => port = input(&bytes(file, length)?)?,
            _ => skip(file, length)?,
        }
    }
    Ok(port.map(|(input, shape)| Outline { input, shape, normalises: normalises == Some(true) }))
}

/// Name and extents of a `ValueInfoProto` whose tensor has four extents.
fn input(mut port: &[u8]) -> io::Result<Option<(String, [i64; 4])>> {
    let (mut name, mut shape) = (String::new(), Vec::new());
    while let Some((number, value)) = part(&mut port)? {
        match number {
            1 => name = String::from_utf8_lossy(value).into_owned(),
            // TypeProto.tensor_type 1, Tensor.shape 2, TensorShapeProto.dim 1
            2 => {
                let dims = all(value, 1)?.into_iter().map(|t| all(t, 2)).collect::<io::Result<Vec<_>>>()?.concat();
                for dim in dims.into_iter().map(|s| all(s, 1)).collect::<io::Result<Vec<_>>>()?.concat() {
                    shape.push(extent(dim)?);
                }
            }
            _ => {}
        }
    }
    Ok(shape.try_into().ok().map(|shape| (name, shape)))
}

/// `dim_value` 1 of a dimension; −1 where it has a name or nothing.
fn extent(mut dim: &[u8]) -> io::Result<i64> {
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

/// The next length-delimited field; numbers are passed over.
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

/// The next field's number and value, up to the bytes of it; none at the end.
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

    use proptest::prelude::*;

    use super::*;

    const MEAN: &[u8] = include_bytes!("../../../../tests/onnx/mean.onnx");

    #[test]
    fn the_input_of_a_small_graph() {
        let got = outline(&mut Cursor::new(MEAN)).unwrap();
        assert_eq!((got.shape[1], got.shape[2], got.shape[3], got.normalises), (3, -1, -1, false));
        assert!(!got.input.is_empty());
    }

    /// A length-delimited field.
    fn field(number: u8, value: &[u8]) -> Vec<u8> {
        let length = value.len();
        [&[number << 3 | 2, (length & 0x7F) as u8 | 0x80, (length >> 7) as u8], value].concat()
    }

    #[test]
    fn a_graph_that_normalises_by_itself() {
        let dims = [field(1, &[8, 1]), field(1, &[8, 3]), field(1, &[8, 0x80, 3]), field(1, &field(2, b"w"))].concat();
        let port = field(11, &[field(1, b"image"), field(2, &field(1, &[vec![8, 1], field(2, &dims)].concat()))].concat());
        let file = |operators: &[&str]| {
            let nodes = operators.iter().flat_map(|name| field(1, &[field(1, b"x"), field(4, name.as_bytes())].concat()));
            // A version, weights, and what follows the graph
            let graph = [nodes.collect::<Vec<_>>(), field(5, &[7; 300]), port.clone()].concat();
            [vec![8, 7], field(2, b"test"), field(7, &graph), field(8, &[16, 13])].concat()
        };
        let of = |operators: &[&str]| outline(&mut Cursor::new(file(operators))).unwrap();
        let names = [["Identity"; 100].as_slice(), &["Sub", "Div", "Conv"]].concat();
        assert_eq!(of(&names), Outline { input: "image".into(), shape: [1, 3, 384, -1], normalises: true });
        assert!(!of(&["Pad", "Conv", "Sub"]).normalises && !of(&[]).normalises);
    }

    #[test]
    fn what_is_no_network_has_none() {
        assert_eq!(outline(&mut Cursor::new(b"")), None);
        assert_eq!(outline(&mut Cursor::new(b"[package]\nname = 1")), None);
        assert_eq!(outline(&mut Cursor::new(include_bytes!("../../../../tests/onnx/sum_difference.onnx"))), None);
    }

    proptest! {
        #[test]
        fn spoilt_files_do_no_harm(at in 0..MEAN.len(), byte in any::<u8>(), length in 0..MEAN.len()) {
            let mut spoilt = MEAN.to_vec();
            spoilt[at] = byte;
            let _ = outline(&mut Cursor::new(&spoilt));
            let _ = outline(&mut Cursor::new(&MEAN[..length]));
        }
    }
}
