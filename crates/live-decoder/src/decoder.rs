//! The state of an instance, and its functions.

use std::collections::VecDeque;
use std::time::Duration;

use prost::bytes::Bytes;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self, Bye, Hello, Sound, Statistics, Video};
use tmpi_core::live::{Changes, Colour, FrameTiming, I420, KeyFrame, Layers, TileState, VERSION, key_frame, read, to_rgb, write};
use tmpi_core::{BorderColours, Class, Photo};

/// Results that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Output {
    /// Why the last call failed: text.
    Text = 0,
    /// Text of a panic.
    Panic = 1,
    /// Numbers of the last message, 64-bit floats, little-endian (see `Decoder::message`).
    Numbers = 2,
    /// Bytes of the last message: video, sound or text.
    Data = 3,
    /// The tiles that changed last, as pairs of 32-bit numbers: the tile, and its number of layers, or 2³² − 1 if it keeps its layers.
    Tiles = 4,
    /// Numbers of the layers of tiles whose layers changed, 64-bit floats, row by row (see `Decoder::layers`).
    Layers = 5,
    /// Texels of the layers requested last, premultiplied RGBA, row by row, layer after layer, and the border's means.
    Cells = 6,
    /// The last message written.
    Message = 7,
}

/// Pixel format of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Pixels {
    /// Luma, then two planes of chroma at half the width and height.
    I420 = 0,
    /// Luma, then interleaved pairs of chroma.
    Nv12 = 1,
    /// Four bytes per pixel.
    Rgba = 2,
}

/// Number of format changes that are kept, because frames are shown later than they arrive.
const KEPT_FORMATS: usize = 8;

/// Properties from a key frame: colours, and the columns and rows cropped at the left and at the top.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Format {
    colour: Colour,
    left: u32,
    top: u32,
}

/// Tiles are kept for a later frame if it is at most this many frames ahead. If it is farther, frames were not sent, and the shown tiles are
/// older still.
const MAX_AHEAD: u64 = 24;
/// Maximum number of messages with such tiles; with more, the oldest are shown too early.
const KEPT_TILES: usize = 16;

/// Number of layers that marks a tile that keeps its layers.
const UNCHANGED: u32 = u32::MAX;

/// Reads and writes the messages of one connection, and holds the layers of one room.
#[derive(Default)]
pub struct Decoder {
    input: Vec<u8>,
    model: Option<TileState>,
    /// Frame size of the room in pixels, and its codec.
    size: (u32, u32),
    codec: String,
    /// Changes of the format: number of the first frame, and format.
    formats: VecDeque<(u64, Format)>,
    /// Bits of the sizes, camera and view box in HELLO.
    hello_bits: [u64; 11],
    /// Tiles received since the last update of the layers.
    changed: Vec<bool>,
    frame: Option<Photo>,
    layers: Layers,
    numbers: Vec<u8>,
    data: Bytes,
    tiles: Vec<u8>,
    rows: Vec<u8>,
    cells: Vec<[u8; 4]>,
    message: Bytes,
    /// Capture time of the last frame, by the publisher's clock, and of the last frame at which the layers were updated.
    taken: Duration,
    shown: Duration,
    /// Number of the last frame, and whether it came since HELLO.
    number: u64,
    has_frame: bool,
    /// Tiles of later frames, which the browser has not decoded yet.
    early: VecDeque<schema::Geometry>,
    /// Newest frame with tiles since the last update of the layers.
    tiles_of: Option<u64>,
    /// Why the last call failed.
    pub text: String,
}

impl Decoder {
    /// The input buffer of the next call, resized to `length` bytes.
    pub fn room(&mut self, length: usize) -> &mut [u8] {
        self.input.resize(length, 0);
        &mut self.input
    }

    /// Reads a message and updates the state of the room; returns the number of its kind.
    ///
    /// # Errors
    /// The message is invalid, or tiles come before HELLO.
    pub fn message(&mut self) -> Result<i32, String> {
        let kind = read(std::mem::take(&mut self.input).into()).map_err(|e| e.to_string())?;
        self.data = Bytes::new();
        match kind {
            Kind::Hello(hello) => self.hello(&hello),
            Kind::Video(Video { frame, time, key, layer, data }) => {
                if key {
                    self.key(frame, &data);
                }
                self.data = data;
                let Format { colour: Colour { matrix, full_range }, left, top } = self.format_of(frame);
                let (width, height) = self.size;
                let format = [matrix.code().into(), u8::from(full_range).into(), left.into(), top.into(), width.into(), height.into()];
                Ok(self.store_numbers(2, &[&[frame as f64, time as f64, f64::from(u8::from(key)), f64::from(layer)][..], &format].concat()))
            }
            Kind::Geometry(tiles) => self.receive(3, tiles),
            Kind::Snapshot(tiles) => self.receive(4, tiles),
            Kind::Sound(Sound { time, data }) => {
                self.data = data;
                Ok(self.store_numbers(5, &[time as f64]))
            }
            Kind::Statistics(s) => {
                let Statistics { frame, viewers, frames, video_bytes, geometry_bytes, tiles, tiles_left_out, .. } = s;
                let counts = [frame, u64::from(viewers), frames, video_bytes, geometry_bytes, tiles, tiles_left_out, s.skipped];
                let [a, b, c, d, e, f, g, h] = counts.map(|n| n as f64);
                Ok(self.store_numbers(6, &[a, b, c, d, e, f, g, h, s.forward_ms, s.geometry_ms]))
            }
            Kind::Bye(Bye { reason, again, cause }) => {
                self.data = reason.into_bytes().into();
                Ok(self.store_numbers(7, &[f64::from(u8::from(again)), f64::from(cause)]))
            }
            Kind::Credit(c) => Ok(self.store_numbers(8, &[f64::from(c.frames), f64::from(u8::from(c.key))])),
            // only the server uses measured depth
            Kind::Depth(_) => Ok(self.store_numbers(9, &[])),
        }
    }

    /// Reads the properties of a key frame. Ignores invalid ones, which the video decoder reports.
    fn key(&mut self, frame: u64, data: &[u8]) {
        let Ok(Some(KeyFrame { colour, left, top, .. })) = key_frame(&self.codec, data) else { return };
        let format = Format { colour, left, top };
        if self.formats.back().is_none_or(|&(_, before)| before != format) {
            self.formats.push_back((frame, format));
        }
        if self.formats.len() > KEPT_FORMATS {
            self.formats.pop_front();
        }
    }

    /// The format of a frame.
    fn format_of(&self, frame: u64) -> Format {
        let since = self.formats.iter().rev().find(|(first, _)| *first <= frame);
        since.map(|(_, format)| *format).unwrap_or_default()
    }

    /// Stores the numbers of a message; returns its `kind`.
    fn store_numbers(&mut self, kind: i32, numbers: &[f64]) -> i32 {
        self.numbers = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        kind
    }

    /// Resets the tiles; the current layers stay until all tiles have arrived.
    fn hello(&mut self, h: &Hello) -> Result<i32, String> {
        let model = TileState::new(h).map_err(|e| e.to_string())?;
        self.changed = vec![false; model.tiles() as usize];
        let [width, height, size, stride] = [h.width, h.height, h.tile_size, h.tile_stride].map(f64::from);
        let numbers = [width, height, size, stride, h.fx, h.fy, h.cx, h.cy, h.view_x, h.view_y, h.view_z];
        let bits = numbers.map(f64::to_bits);
        if self.hello_bits != bits {
            (self.size, self.hello_bits) = ((h.width, h.height), bits);
            (self.frame, self.layers) = (None, Layers::with_memory());
        }
        self.model = Some(model);
        self.formats.clear();
        self.codec.clone_from(&h.codec);
        self.tiles_of = None;
        self.early.clear();
        self.has_frame = false;
        self.data = format!("{}\n{}", h.codec, h.sound).into_bytes().into();
        Ok(self.store_numbers(1, &[&numbers[..], &[f64::from(h.sound_rate), f64::from(h.sound_channels), h.epoch as f64]].concat()))
    }

    /// Takes tiles, or keeps them until their frame comes.
    fn receive(&mut self, kind: i32, tiles: schema::Geometry) -> Result<i32, String> {
        let number = tiles.frame;
        let is_ahead = number > self.number && number - self.number <= MAX_AHEAD;
        let count = if self.has_frame && is_ahead {
            self.early.push_back(tiles);
            self.take_early()?
        } else {
            self.take(&tiles)?
        };
        Ok(self.store_numbers(kind, &[number as f64, count as f64]))
    }

    /// Takes the kept tiles of frames up to the last one, and of the first if there are too many. Returns the number of tiles.
    fn take_early(&mut self) -> Result<usize, String> {
        let mut count = 0;
        while let Some(first) = self.early.front()
            && (first.frame <= self.number || self.early.len() > KEPT_TILES)
        {
            let tiles = self.early.pop_front().unwrap_or_default();
            count += self.take(&tiles)?;
        }
        Ok(count)
    }

    fn take(&mut self, tiles: &schema::Geometry) -> Result<usize, String> {
        let model = self.model.as_mut().ok_or("tiles before HELLO")?;
        let taken = model.take(tiles).map_err(|e| e.to_string())?;
        for t in &taken {
            self.changed[*t as usize] = true;
        }
        self.tiles_of = self.tiles_of.max(Some(tiles.frame));
        Ok(taken.len())
    }

    /// Takes the input buffer as the next frame: its pixel format, number, and capture time in µs by the publisher's clock. A previous one
    /// that [`Self::layers`] has not shown is remembered for its tiles, which arrive later.
    ///
    /// # Errors
    /// The input has a wrong length for the room's frame size, or kept tiles are invalid.
    pub fn frame(&mut self, format: u32, number: u64, time: u64) -> Result<i32, String> {
        let (width, height) = self.size;
        let area = width as usize * height as usize;
        let chroma = width.div_ceil(2) as usize * height.div_ceil(2) as usize;
        let bytes = std::mem::take(&mut self.input);
        let want = if format == Pixels::Rgba as u32 { 4 * area } else { area + 2 * chroma };
        if bytes.len() != want {
            return Err(format!("a frame of {} bytes; expected {want}", bytes.len()));
        }
        let (y, rest) = bytes.split_at(area);
        let colour = self.format_of(number).colour;
        let i420 = |u: &[u8], v: &[u8]| to_rgb(&I420 { width, height, y, u, v }, colour);
        self.skip();
        self.taken = Duration::from_micros(time);
        (self.number, self.has_frame) = (number, true);
        self.take_early()?;
        self.frame = match format {
            f if f == Pixels::I420 as u32 => i420(&rest[..chroma], &rest[chroma..]),
            f if f == Pixels::Nv12 as u32 => {
                let (u, v): (Vec<u8>, Vec<u8>) = rest.as_chunks().0.iter().map(|&[u, v]| (u, v)).unzip();
                i420(&u, &v)
            }
            _ => Some(Photo { width, height, rgb: bytes.as_chunks().0.iter().map(|&[r, g, b, _]| [r, g, b]).collect() }),
        };
        Ok(1)
    }

    /// Remembers the frame that was taken last and not shown.
    fn skip(&mut self) {
        if let Some(frame) = self.frame.take() {
            self.layers.skip(&frame, self.number, self.taken.saturating_sub(self.shown));
        }
    }

    /// Updates the layers to the last frame and tiles; returns the number of changed tiles. Stores these tiles, and a row for each layer of
    /// those whose layers changed: a, b, c of the plane, x, y, w, h of the rectangle, number of visible texels, and whether any texel is
    /// soft.
    pub fn layers(&mut self) -> i32 {
        (self.tiles, self.rows) = (Vec::new(), Vec::new());
        let Some(geometry) = self.model.as_ref().and_then(TileState::geometry) else { return 0 };
        let shown = self.layers.photo();
        let again = || (!shown.rgb.is_empty()).then(|| shown.clone());
        let elapsed = self.frame.is_some().then(|| self.taken.saturating_sub(std::mem::replace(&mut self.shown, self.taken)));
        let Some(frame) = self.frame.take().or_else(again) else { return 0 };
        let when = FrameTiming { frame: self.number, tiles: self.tiles_of.take(), elapsed };
        let changed = std::mem::replace(&mut self.changed, vec![false; geometry.tiles.len()]);
        let Changes { texels, layers } = self.layers.update(geometry, |t| changed[t as usize], frame, when);
        for t in &texels {
            let other = layers.binary_search(t).is_ok();
            let part = self.layers.tile(*t).filter(|_| other);
            let count = part.map_or(UNCHANGED, |part| part.layers.len() as u32);
            self.tiles.extend([*t, count].map(u32::to_le_bytes).as_flattened());
            for l in part.map_or(&[][..], |part| &part.layers) {
                let own = l.first_texel..l.first_texel + l.rect.area();
                let texels = part.map(|part| (&part.texels.class[own.clone()], &part.texels.alpha[own]));
                let (class, alpha) = texels.unwrap_or_default();
                let visible = class.iter().filter(|&&c| c == Class::Photo as u8).count() as f64;
                let soft = f64::from(u8::from(alpha.iter().any(|&a| a < u8::MAX)));
                let [x, y, w, h] = [l.rect.x, l.rect.y, l.rect.w, l.rect.h].map(f64::from);
                self.rows.extend([l.plane.a, l.plane.b, l.plane.c, x, y, w, h, visible, soft].map(f64::to_le_bytes).as_flattened());
            }
        }
        texels.len() as i32
    }

    /// Stores the texels of the layers in the input buffer, each a pair of 32-bit numbers: the tile, and the layer's index in it. Then come the
    /// means along the frame's borders, [`BorderColours::strips`] of `columns`, from which the shader continues the frame.
    ///
    /// # Errors
    /// A layer does not exist.
    pub fn cells(&mut self, columns: usize) -> Result<i32, String> {
        self.cells.clear();
        for numbers in self.input.as_chunks().0 {
            let both = u64::from_le_bytes(*numbers);
            if !self.layers.texels(both as u32, (both >> 32) as usize, &mut self.cells) {
                return Err("there is no such layer".into());
            }
        }
        if columns > 0 {
            let Photo { width, height, rgb } = self.layers.photo();
            self.cells.extend(BorderColours::new(rgb, [*width, *height], 0).strips(columns));
        }
        Ok(1)
    }

    /// Writes HELLO of a publisher. The input buffer has the codec strings of video and sound, one per line.
    ///
    /// # Errors
    /// The codec strings are not UTF-8.
    pub fn write_hello(&mut self, (width, height): (u32, u32), fov_x: f64, sound: (u32, u32)) -> Result<i32, String> {
        let text = String::from_utf8(std::mem::take(&mut self.input)).map_err(|e| e.to_string())?;
        let (codec, named) = text.split_once('\n').unwrap_or((&text, ""));
        let (codec, sound_name) = (codec.to_owned(), named.to_owned());
        let (sound_rate, sound_channels) = sound;
        let hello =
            Hello { version: VERSION, codec, width, height, fov_x, sound: sound_name, sound_rate, sound_channels, ..Hello::default() };
        self.message = write(Kind::Hello(hello));
        Ok(1)
    }

    /// Writes VIDEO of a temporal layer with the input buffer as data; returns 1.
    pub fn write_video(&mut self, frame: u64, time: u64, key: bool, layer: u32) -> i32 {
        let data = std::mem::take(&mut self.input).into();
        self.message = write(Kind::Video(Video { frame, time, key, layer, data }));
        1
    }

    /// Writes SOUND with the input buffer as data; returns 1.
    pub fn write_sound(&mut self, time: u64) -> i32 {
        let data = std::mem::take(&mut self.input).into();
        self.message = write(Kind::Sound(Sound { time, data }));
        1
    }

    /// Writes BYE with the input buffer as reason; returns 1.
    pub fn write_bye(&mut self) -> i32 {
        let reason = String::from_utf8_lossy(&std::mem::take(&mut self.input)).into_owned();
        self.message = write(Kind::Bye(Bye { reason, ..Bye::default() }));
        1
    }

    /// The bytes of the result with the number of an [`Output`].
    pub fn output(&self, what: u32) -> &[u8] {
        const OUTPUTS: [Output; 7] =
            [Output::Text, Output::Numbers, Output::Data, Output::Tiles, Output::Layers, Output::Cells, Output::Message];
        match OUTPUTS.into_iter().find(|o| *o as u32 == what) {
            Some(Output::Text) => self.text.as_bytes(),
            Some(Output::Numbers) => &self.numbers,
            Some(Output::Data) => &self.data,
            Some(Output::Tiles) => &self.tiles,
            Some(Output::Layers) => &self.rows,
            Some(Output::Cells) => self.cells.as_flattened(),
            Some(Output::Message) => &self.message,
            Some(Output::Panic) | None => &[],
        }
    }
}
