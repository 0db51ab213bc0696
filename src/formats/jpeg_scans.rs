//! Whether the scans of a JPEG hold as many blocks as its header says.
//!
//! A file that was cut and got an end marker again looks whole from the outside, and a decoder fills what is missing with
//! grey. So the blocks are counted: their Huffman codes are read and what they say is left alone. Only what is certain
//! is reported; of a file of an unusual kind, or with damage in the middle, the decoder may make what it can.

use super::bounded::MAX_PIXELS;

/// More scans are left to the decoder, which refuses them.
const MAX_SCANS: usize = 128;

/// Whether a scan ends while more than a part of its last block is missing, or a component has no scan. `false` for what
/// cannot be told: arithmetic coding, lossless pictures, heights that stand behind the scan.
pub(super) fn end_early(bytes: &[u8]) -> bool {
    Picture::default().walk(bytes) == Some(true)
}

/// Why the reading of codes stops.
enum Stop {
    /// There are no more bits before the next marker.
    End,
    /// The same, and the block is its unit's last: some encoders drop its last bits.
    EndInLast,
    /// What is there is no code.
    Strange,
}

#[derive(Default)]
struct Picture {
    width: usize,
    height: usize,
    progressive: bool,
    components: Vec<Component>,
    /// Of means and of the rest, four each.
    tables: [[Option<Table>; 4]; 2],
    /// Units between restart markers; 0 for no such markers.
    restart: usize,
}

struct Component {
    id: u8,
    across: usize,
    down: usize,
    /// Blocks in a row of whole units.
    stride: usize,
    /// Of each block the coefficients that are not 0 so far, where later scans refine them.
    known: Vec<u64>,
    begun: bool,
}

/// A component in a scan: its index, and which tables.
struct Part {
    component: usize,
    means: usize,
    rest: usize,
}

/// Which coefficients a scan holds: from, to, and whether it refines them.
struct Band {
    from: usize,
    to: usize,
    refines: bool,
}

impl Picture {
    /// As [`end_early`]; nothing if that cannot be told.
    fn walk(&mut self, bytes: &[u8]) -> Option<bool> {
        let (mut at, mut scans) = (2, 0);
        loop {
            at = next_marker(bytes, at)?;
            let marker = bytes[at + 1];
            at += 2;
            match marker {
                0x01 | 0xd0..=0xd7 => continue,
                0xd9 => return Some(self.components.iter().any(|c| !c.begun)),
                _ => {}
            }
            let length = usize::from(u16::from_be_bytes(*bytes.get(at..)?.first_chunk()?));
            let segment = bytes.get(at + 2..at + length)?;
            at += length;
            match marker {
                0xc0..=0xc2 => self.read_frame(segment, marker == 0xc2)?,
                0xc4 => self.read_tables(segment)?,
                // Frames of other kinds, and arithmetic coding.
                0xc3 | 0xc5..=0xcf => return None,
                0xdd => self.restart = usize::from(u16::from_be_bytes(*segment.first_chunk()?)),
                0xda => {
                    scans += 1;
                    let mut bits = Bits { bytes, at, held: 0, count: 0 };
                    let whole = self.read_scan(segment, &mut bits)?;
                    if !whole || scans > MAX_SCANS {
                        return (!whole).then_some(true);
                    }
                    at = bits.at;
                }
                _ => {}
            }
        }
    }

    fn read_frame(&mut self, segment: &[u8], progressive: bool) -> Option<()> {
        let &[_, h1, h0, w1, w0, count, ref factors @ ..] = segment else { return None };
        (self.width, self.height) =
            (usize::from(u16::from_be_bytes([w1, w0])), usize::from(u16::from_be_bytes([h1, h0])));
        self.progressive = progressive;
        let factors: Vec<&[u8]> = factors.chunks_exact(3).collect();
        let good = |c: &&[u8]| (1..=4).contains(&(c[1] >> 4)) && (1..=4).contains(&(c[1] & 15));
        let pixels = self.width * self.height;
        if pixels == 0
            || pixels as u64 > MAX_PIXELS
            || !self.components.is_empty()
            || factors.len() != usize::from(count)
            || !(1..=4).contains(&factors.len())
            || !factors.iter().all(good)
        {
            return None;
        }
        let component = |c: &[u8]| Component {
            id: c[0],
            across: usize::from(c[1] >> 4),
            down: usize::from(c[1] & 15),
            stride: 0,
            known: Vec::new(),
            begun: false,
        };
        self.components = factors.into_iter().map(component).collect();
        let [across, down] = self.units();
        for c in &mut self.components {
            c.stride = across * c.across;
            if progressive {
                c.known = vec![0; c.stride * down * c.down];
            }
        }
        Some(())
    }

    /// The largest sampling factors, across and down.
    fn finest(&self) -> [usize; 2] {
        self.components.iter().fold([1, 1], |[a, d], c| [a.max(c.across), d.max(c.down)])
    }

    /// How many units of all components there are, across and down.
    fn units(&self) -> [usize; 2] {
        let [across, down] = self.finest();
        [self.width.div_ceil(8 * across), self.height.div_ceil(8 * down)]
    }

    fn read_tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&which, rest)) = segment.split_first() {
            let (counts, rest) = rest.split_first_chunk::<16>()?;
            let total = counts.iter().map(|&n| usize::from(n)).sum();
            let (values, rest) = rest.split_at_checked(total)?;
            *self.tables.get_mut(usize::from(which >> 4))?.get_mut(usize::from(which & 15))? =
                Some(Table::new(counts, values));
            segment = rest;
        }
        Some(())
    }

    /// Whether the scan is whole but for the end of its last block.
    fn read_scan(&mut self, header: &[u8], bits: &mut Bits) -> Option<bool> {
        let (&count, rest) = header.split_first()?;
        let (parts, rest) = rest.split_at_checked(2 * usize::from(count))?;
        let &[from, to, precision, ..] = rest else { return None };
        let mut found = Vec::new();
        for part in parts.chunks_exact(2) {
            let component = self.components.iter().position(|c| c.id == part[0])?;
            found.push(Part { component, means: usize::from(part[1] >> 4) & 3, rest: usize::from(part[1] & 3) });
        }
        let band = match self.progressive {
            true => Band { from: usize::from(from), to: usize::from(to), refines: precision >> 4 > 0 },
            false => Band { from: 0, to: 63, refines: false },
        };
        let wrong = band.to > 63 || band.from > band.to || (self.progressive && band.from == 0 && band.to > 0);
        if found.is_empty() || wrong || (band.from > 0 && found.len() > 1) {
            return None;
        }
        if band.from == 0 {
            found.iter().for_each(|part| self.components[part.component].begun = true);
        }
        // A component alone comes block by block, as many as its own size needs.
        let [across, down] = match &found[..] {
            [one] => {
                let ([finest_across, finest_down], c) = (self.finest(), &self.components[one.component]);
                [(self.width * c.across).div_ceil(8 * finest_across), (self.height * c.down).div_ceil(8 * finest_down)]
            }
            _ => self.units(),
        };
        let total = across * down;
        let (mut unit, mut run) = (0, 0);
        while unit < total {
            if self.restart > 0 && unit > 0 && unit.is_multiple_of(self.restart) {
                run = 0;
                if !bits.restart() {
                    return Some(false);
                }
            }
            match self.read_unit([unit % across, unit / across], &found, &band, &mut run, bits) {
                Ok(()) => unit += 1,
                Err(Stop::Strange) => return None,
                // Damage within a part that a restart marker ends: the next one begins at its place.
                Err(_) if bits.at_restart() && self.restart > 0 => unit = (unit / self.restart + 1) * self.restart,
                Err(Stop::End) => return Some(false),
                Err(Stop::EndInLast) => return Some(unit + 1 >= total),
            }
        }
        Some(true)
    }

    fn read_unit(
        &mut self,
        [x, y]: [usize; 2],
        parts: &[Part],
        band: &Band,
        run: &mut usize,
        bits: &mut Bits,
    ) -> Result<(), Stop> {
        let Picture { components, tables: [means, rest], progressive, .. } = self;
        for (i, part) in parts.iter().enumerate() {
            let c = &mut components[part.component];
            let tables = [means[part.means].as_ref(), rest[part.rest].as_ref()];
            let (across, down) = if parts.len() > 1 { (c.across, c.down) } else { (1, 1) };
            for block in 0..across * down {
                let at = (y * down + block / across) * c.stride + x * across + block % across;
                let known = if *progressive { Some(c.known.get_mut(at).ok_or(Stop::Strange)?) } else { None };
                let last = i + 1 == parts.len() && block + 1 == across * down;
                read_block(tables, known, band, run, bits).map_err(|stop| match stop {
                    Stop::End if last => Stop::EndInLast,
                    stop => stop,
                })?;
            }
        }
        Ok(())
    }
}

/// One block; what is `known` of it belongs to progressive pictures.
fn read_block(
    [means, rest]: [Option<&Table>; 2],
    known: Option<&mut u64>,
    band: &Band,
    run: &mut usize,
    bits: &mut Bits,
) -> Result<(), Stop> {
    match known {
        Some(known) if band.from > 0 => {
            let table = rest.ok_or(Stop::Strange)?;
            if band.refines { refine(table, band, known, run, bits) } else { first(table, band, known, run, bits) }
        }
        Some(_) if band.refines => bits.take(1).map(drop),
        progressive => {
            let length = means.ok_or(Stop::Strange)?.next(bits)?;
            bits.take(u32::from(length))?;
            if progressive.is_some() { Ok(()) } else { sequential(rest.ok_or(Stop::Strange)?, bits) }
        }
    }
}

/// All coefficients of a block but the mean.
fn sequential(table: &Table, bits: &mut Bits) -> Result<(), Stop> {
    let mut k = 1;
    while k < 64 {
        let code = table.next(bits)?;
        let (zeros, length) = (usize::from(code >> 4), u32::from(code & 15));
        match (zeros, length) {
            (15, 0) => k += 16,
            (_, 0) => return Ok(()),
            _ => {
                bits.take(length)?;
                k += zeros + 1;
            }
        }
    }
    if k > 64 { Err(Stop::Strange) } else { Ok(()) }
}

/// The first bits of some coefficients; `run` blocks more have none.
fn first(table: &Table, band: &Band, known: &mut u64, run: &mut usize, bits: &mut Bits) -> Result<(), Stop> {
    if *run > 0 {
        *run -= 1;
        return Ok(());
    }
    let mut k = band.from;
    while k <= band.to {
        let code = table.next(bits)?;
        let (zeros, length) = (usize::from(code >> 4), u32::from(code & 15));
        match (zeros, length) {
            (15, 0) => k += 16,
            (_, 0) => {
                *run = (1 << zeros) - 1 + bits.take(zeros as u32)? as usize;
                return Ok(());
            }
            _ => {
                bits.take(length)?;
                k += zeros;
                if k > band.to {
                    return Err(Stop::Strange);
                }
                *known |= 1 << k;
                k += 1;
            }
        }
    }
    Ok(())
}

/// One more bit of some coefficients: of every one that is known, and those that now become so.
fn refine(table: &Table, band: &Band, known: &mut u64, run: &mut usize, bits: &mut Bits) -> Result<(), Stop> {
    let mut k = band.from;
    while *run == 0 && k <= band.to {
        let code = table.next(bits)?;
        let (mut zeros, length) = (code >> 4, code & 15);
        match length {
            0 if zeros < 15 => {
                *run = (1 << zeros) + bits.take(u32::from(zeros))? as usize;
                break;
            }
            0 => {}
            1 => drop(bits.take(1)?),
            _ => return Err(Stop::Strange),
        }
        while k <= band.to {
            if *known >> k & 1 == 1 {
                bits.take(1)?;
            } else if zeros == 0 {
                break;
            } else {
                zeros -= 1;
            }
            k += 1;
        }
        if length == 1 && k <= band.to {
            *known |= 1 << k;
        }
        k += 1;
    }
    if *run > 0 {
        let left = if k > 63 { 0 } else { *known >> k << k & (u64::MAX >> (63 - band.to)) };
        for _ in 0..left.count_ones() {
            bits.take(1)?;
        }
        *run -= 1;
    }
    Ok(())
}

/// Where the next marker stands, from `at`: a byte 0xff and one that is neither 0 nor 0xff.
fn next_marker(bytes: &[u8], at: usize) -> Option<usize> {
    let found = bytes.get(at..)?.windows(2).position(|pair| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff))?;
    Some(at + found)
}

/// The bits of a scan, up to a marker.
struct Bits<'a> {
    bytes: &'a [u8],
    /// The next byte.
    at: usize,
    /// Bits that are read and not used, the next one highest of `count`.
    held: u64,
    count: u32,
}

impl Bits<'_> {
    fn fill(&mut self) {
        while self.count <= 48 {
            let (byte, length) = match *self.bytes.get(self.at..).unwrap_or_default() {
                [0xff, 0, ..] => (0xff, 2),
                [0xff, ..] | [] => return,
                [byte, ..] => (byte, 1),
            };
            self.at += length;
            self.held = self.held << 8 | u64::from(byte);
            self.count += 8;
        }
    }

    /// The next `n` bits, at most 16.
    fn take(&mut self, n: u32) -> Result<u64, Stop> {
        if self.count < n {
            self.fill();
            if self.count < n {
                return Err(Stop::End);
            }
        }
        self.count -= n;
        Ok(self.held >> self.count & ((1 << n) - 1))
    }

    /// The next 16 bits; what is missing of them is 0.
    fn ahead(&mut self) -> usize {
        if self.count < 16 {
            self.fill();
        }
        let bits = if self.count >= 16 { self.held >> (self.count - 16) } else { self.held << (16 - self.count) };
        (bits & 0xffff) as usize
    }

    fn at_restart(&self) -> bool {
        next_marker(self.bytes, self.at).is_some_and(|at| matches!(self.bytes[at + 1], 0xd0..=0xd7))
    }

    /// Goes behind the next restart marker; whether it is one that comes next.
    fn restart(&mut self) -> bool {
        (self.held, self.count) = (0, 0);
        let found = self.at_restart();
        if let Some(at) = next_marker(self.bytes, self.at).filter(|_| found) {
            self.at = at + 2;
        }
        found
    }
}

/// A Huffman table: for all 16 bits that may come, the length of the code that they begin with, and its value.
struct Table {
    /// By the first nine bits: length and value; length 0 for longer codes.
    short: Vec<(u8, u8)>,
    /// Of each length: the first 16 bits (from above) that begin no code of it or a shorter one, and from where its values
    /// count.
    long: [(usize, usize); 17],
    values: Vec<u8>,
}

const SHORT: usize = 9;

impl Table {
    fn new(counts: &[u8; 16], values: &[u8]) -> Table {
        let mut table = Table { short: vec![(0, 0); 1 << SHORT], long: [(0, 0); 17], values: values.to_vec() };
        let (mut code, mut index) = (0, 0);
        for (length, &count) in (1..).zip(counts) {
            for _ in 0..count {
                if length <= SHORT && index < values.len() {
                    let from = code << (SHORT - length);
                    let to = (from + (1 << (SHORT - length))).min(1 << SHORT);
                    table.short[from.min(to)..to].fill((length as u8, values[index]));
                }
                code += 1;
                index += 1;
            }
            // Values of this length begin `code - count` codes in, at `index - count`.
            table.long[length] = (code << (16 - length), index.wrapping_sub(code));
            code <<= 1;
        }
        table
    }

    /// The value of the next code.
    fn next(&self, bits: &mut Bits) -> Result<u8, Stop> {
        let ahead = bits.ahead();
        let (length, value) = match self.short[ahead >> (16 - SHORT)] {
            (0, _) => {
                let length = (SHORT + 1..=16).find(|&length| ahead < self.long[length].0).ok_or(Stop::Strange);
                // Nothing but missing bits may make it strange.
                let length = if bits.count < 16 { length.map_err(|_| Stop::End)? } else { length? };
                let value = (ahead >> (16 - length)).wrapping_add(self.long[length].1);
                (length as u32, *self.values.get(value).ok_or(Stop::Strange)?)
            }
            (length, value) => (u32::from(length), value),
        };
        bits.take(length)?;
        Ok(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::fixture_bytes;

    fn encoded(width: u32, height: u32, quality: u8) -> Vec<u8> {
        let mut bytes = Vec::new();
        let picture = image::RgbImage::from_fn(width, height, |x, y| {
            image::Rgb([(6 * x) as u8, (8 * y) as u8 ^ (x * 37) as u8, (x * y) as u8])
        });
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(&picture).unwrap();
        bytes
    }

    /// A file's beginning, with an end marker.
    fn cut(bytes: &[u8], share: f64) -> Vec<u8> {
        [&bytes[..(bytes.len() as f64 * share) as usize], b"\xff\xd9"].concat()
    }

    #[test]
    fn whole_pictures_of_any_size_are_whole() {
        for (width, height) in [(1, 1), (8, 8), (17, 9), (40, 30), (163, 97)] {
            for quality in [5, 50, 100] {
                assert!(!end_early(&encoded(width, height, quality)), "{width}x{height} at {quality}");
            }
        }
    }

    #[test]
    fn a_cut_picture_with_an_end_marker_is_cut() {
        for quality in [20, 75, 100] {
            let bytes = encoded(163, 97, quality);
            let scan = next_scan(&bytes) as f64 / bytes.len() as f64;
            for share in [0.02, 0.3, 0.5, 0.9, 0.98] {
                assert!(end_early(&cut(&bytes, scan + (1.0 - scan) * share)), "at {share} of quality {quality}");
            }
            if quality == 100 {
                // The last byte is padding and part of the last block.
                assert!(!end_early(&[&bytes[..bytes.len() - 3], b"\xff\xd9"].concat()));
            }
        }
    }

    /// Where the first scan's bits begin.
    fn next_scan(bytes: &[u8]) -> usize {
        bytes.windows(2).position(|pair| pair == b"\xff\xda").unwrap() + 14
    }

    #[test]
    fn what_it_does_not_know_or_cannot_read_is_left_to_the_decoder() {
        let bytes = encoded(40, 30, 75);
        let mut arithmetic = bytes.clone();
        let frame = bytes.windows(2).position(|pair| pair == b"\xff\xc0").unwrap();
        arithmetic[frame + 1] = 0xc9;
        assert!(!end_early(&cut(&arithmetic, 0.9)));
        for end in 0..bytes.len() {
            // Must not panic, whatever is there.
            end_early(&bytes[..end]);
            let mut damaged = bytes.clone();
            damaged[end] ^= 0x55;
            end_early(&damaged);
        }
    }

    #[test]
    fn progressive_pictures_are_counted_too() {
        for name in ["progressive.jpg", "progressive_restart.jpg", "restart.jpg", "subsampled.jpg"] {
            let bytes = fixture_bytes(&format!("pictures/{name}"));
            assert!(!end_early(&bytes), "{name}");
            let mut markers = vec![];
            let mut at = 2;
            while let Some(found) = next_marker(&bytes, at) {
                markers.push(found);
                at = found + 2;
            }
            // Everywhere but within headers and the last block of a scan.
            let within = |end: usize| {
                let Some(before) = markers.iter().rfind(|&&m| m < end) else { return false };
                let Some(after) = markers.iter().find(|&&m| m >= end) else { return false };
                let begun = match bytes[before + 1] {
                    0xda => end > before + 14,
                    marker => matches!(marker, 0xd0..=0xd7),
                };
                begun && (end + 40 < *after || matches!(bytes[after + 1], 0xd0..=0xd7))
            };
            let ends: Vec<usize> = (0..bytes.len() - 2).filter(|&end| within(end)).collect();
            let seen = ends.iter().filter(|&&end| end_early(&[&bytes[..end], b"\xff\xd9"].concat())).count();
            assert!(ends.len() > 100 && seen == ends.len(), "{name}: {seen} of {} cuts are seen", ends.len());
        }
    }
}
