//! Decodes containers repeatedly on one thread, with the photo decoded in advance: `decode_loop FILE... [ROUNDS]`. Use it for timing, and for
//! callgrind with `--toggle-collect='*decode_with*'`.

use std::time::Instant;

use tmpi_core::container::{decode_picture, decode_with};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (mut files, mut rounds) = (Vec::new(), 1);
    for argument in std::env::args().skip(1) {
        match argument.parse() {
            Ok(count) => rounds = count,
            Err(_) => files.push(argument),
        }
    }
    for file in files {
        let bytes = std::fs::read(&file)?;
        let first = decode_with(&bytes, &|format, bytes, most| decode_picture(format, bytes, most))?;
        let digest = first.digest();
        let picture = std::sync::Mutex::new(Some(first.photo));
        let mut times = Vec::new();
        for _ in 0..rounds {
            let start = Instant::now();
            let scene = decode_with(&bytes, &|format, bytes, most| match picture.lock().ok().and_then(|mut p| p.take()) {
                Some(photo) => Ok(photo),
                None => decode_picture(format, bytes, most),
            })?;
            times.push(start.elapsed().as_secs_f64() * 1e3);
            *picture.lock().map_err(|_| "poisoned")? = Some(scene.photo);
        }
        times.sort_by(f64::total_cmp);
        println!(
            "{file}: least {:.1} ms, median {:.1} ms, {digest}",
            times.first().unwrap_or(&0.0),
            times.get(times.len() / 2).unwrap_or(&0.0)
        );
    }
    Ok(())
}
