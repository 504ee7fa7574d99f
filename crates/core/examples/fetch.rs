//! Fetches a container and prints its layers: `cargo run --example fetch -p tmpi-core -- 127.0.0.1:8080 /v1/photos/ID/atlas`.

use std::error::Error;
use std::io::{Read, Write};
use std::net::TcpStream;

use tmpi_core::Class;
use tmpi_core::container::read_geometry;

fn fetch(host: &str, path: &str) -> Result<Vec<u8>, Box<dyn Error>> {
    let mut stream = TcpStream::connect(host)?;
    write!(stream, "GET {path} HTTP/1.0\r\nHost: {host}\r\nConnection: close\r\n\r\n")?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").ok_or("no HTTP answer")? + 4;
    if !answer.starts_with(b"HTTP/1.0 200") && !answer.starts_with(b"HTTP/1.1 200") {
        return Err(String::from_utf8_lossy(&answer).into_owned().into());
    }
    Ok(answer.split_off(end))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let (host, path) = args.next().zip(args.next()).ok_or("usage: layers HOST:PORT PATH")?;
    let geometry = read_geometry(&fetch(&host, &path)?)?;
    for (tile, masks) in geometry.masks().iter().enumerate() {
        for layer in &masks.layers {
            let count = |class: Class| layer.class.iter().filter(|c| **c == class as u8).count();
            let (shown, hidden) = (count(Class::Photo), count(Class::Hidden));
            println!("tile {tile}: {:?} over {:?}, {shown} texels of the photo, {hidden} hidden", layer.plane, layer.rect);
        }
    }
    Ok(())
}
