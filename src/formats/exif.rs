//! What a camera wrote beside its pixels: which way it was held, and how long its lens was.

use exif::{In, Reader, Tag, Value};

/// The diagonal of a 35 mm film's frame, 36 x 24 mm: what an equivalent focal length refers to (CIPA DCG-001).
const FILM_DIAGONAL: f64 = 43.266_615_305_567_87;

/// What is used of a picture's EXIF data; nothing of it needs to be there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Exif {
    /// How the stored picture is to be turned and mirrored, 1 to 8.
    pub orientation: Option<u8>,
    /// Focal length in millimetres, as if the picture's diagonal were that of 35 mm film.
    film_focal: Option<f64>,
    /// Focal length in pixels of the picture as the camera took it.
    pixel_focal: Option<f64>,
    /// Width and height of the picture as the camera took it.
    taken: Option<[f64; 2]>,
}

impl Exif {
    /// Reads what a picture's file holds, with or without the prefix `Exif\0\0`. What is damaged is as if it were missing.
    pub fn parse(raw: &[u8]) -> Exif {
        let tiff = raw.strip_prefix(b"Exif\0\0").unwrap_or(raw).to_vec();
        let read = Reader::new().continue_on_error(true).read_raw(tiff).or_else(|e| e.distill_partial_result(|_| ()));
        let Ok(read) = read else { return Exif::default() };
        let number = |tag: Tag| match &read.get_field(tag, In::PRIMARY)?.value {
            Value::Rational(all) => all.first().map(|x| x.to_f64()),
            value => value.get_uint(0).map(f64::from),
        };
        let above_zero = |tag: Tag| number(tag).filter(|x| *x > 0.0 && x.is_finite());
        // Inches, unless centimetres are named.
        let unit = if number(Tag::FocalPlaneResolutionUnit) == Some(3.0) { 10.0 } else { 25.4 };
        Exif {
            orientation: number(Tag::Orientation).filter(|x| (1.0..=8.0).contains(x)).map(|x| x as u8),
            film_focal: above_zero(Tag::FocalLengthIn35mmFilm),
            pixel_focal: above_zero(Tag::FocalLength)
                .zip(above_zero(Tag::FocalPlaneXResolution))
                .map(|(millimetres, pixels)| millimetres * pixels / unit),
            taken: above_zero(Tag::PixelXDimension).zip(above_zero(Tag::PixelYDimension)).map(|(w, h)| [w, h]),
        }
    }

    /// Focal length in pixels of the stored picture of `width x height`, which may have been made smaller since it was
    /// taken. Nothing if the lens is not told, if the picture was cut to another aspect since, or if its view would be
    /// narrower than 2 degrees or wider than 170.
    pub fn focal(&self, width: f64, height: f64) -> Option<f64> {
        let size = self.taken.unwrap_or([width, height]);
        if ((size[0] / size[1]) / (width / height) - 1.0).abs() > 0.02 {
            return None;
        }
        let by_film = self.film_focal.map(|focal| focal / FILM_DIAGONAL * width.hypot(height));
        let by_sensor = self.pixel_focal.filter(|_| self.taken.is_some()).map(|focal| focal * width / size[0]);
        let view = |focal: &f64| 2.0 * (0.5 * width / focal).atan().to_degrees();
        by_film.or(by_sensor).filter(|focal| (2.0..=170.0).contains(&view(focal)))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use exif::experimental::Writer;
    use exif::{Field, Rational};

    use super::*;

    /// EXIF data with these entries.
    pub(crate) fn exif(entries: &[(Tag, Value)], little: bool) -> Vec<u8> {
        let fields: Vec<Field> = entries
            .iter()
            .map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() })
            .collect();
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        let mut bytes = std::io::Cursor::new(Vec::new());
        writer.write(&mut bytes, little).unwrap();
        bytes.into_inner()
    }

    fn rational(num: u32, denom: u32) -> Value {
        Value::Rational(vec![Rational { num, denom }])
    }

    #[test]
    fn the_orientation_is_found_in_any_byte_order_and_as_short_or_long() {
        for little in [true, false] {
            for turn in 1..=8u16 {
                for value in [Value::Short(vec![turn]), Value::Long(vec![turn.into()])] {
                    let raw = exif(&[(Tag::Orientation, value)], little);
                    assert_eq!(Exif::parse(&raw).orientation, Some(turn as u8), "{little}");
                    assert_eq!(Exif::parse(&[b"Exif\0\0", &raw[..]].concat()).orientation, Some(turn as u8));
                }
            }
            for wrong in [Value::Short(vec![9]), Value::Short(vec![0]), Value::Ascii(vec![b"6".to_vec()])] {
                assert_eq!(Exif::parse(&exif(&[(Tag::Orientation, wrong)], little)).orientation, None);
            }
        }
    }

    #[test]
    fn data_that_are_damaged_say_nothing_and_stop_nothing() {
        let whole = exif(&[(Tag::Orientation, Value::Short(vec![6])), (Tag::FocalLength, rational(4, 1))], true);
        for end in 0..20 {
            assert_eq!(Exif::parse(&whole[..end]), Exif::default(), "cut at {end}");
        }
        for end in 20..whole.len() {
            Exif::parse(&whole[..end]);
        }
        let mut far = whole.clone();
        far[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(Exif::parse(&far), Exif::default());
        for at in 0..whole.len() {
            for bit in 0..8 {
                let mut flipped = whole.clone();
                flipped[at] ^= 1 << bit;
                Exif::parse(&flipped).focal(4000.0, 3000.0);
            }
        }
    }

    #[test]
    fn a_lens_is_as_long_as_its_equivalent_says_of_the_diagonal() {
        let near = |found: Option<f64>, expected: f64| {
            assert!(found.is_some_and(|found| (found / expected - 1.0).abs() < 1e-9), "{found:?}, expected {expected}");
        };
        let taken = [(Tag::PixelXDimension, Value::Long(vec![4000])), (Tag::PixelYDimension, Value::Long(vec![3000]))];
        let film = (Tag::FocalLengthIn35mmFilm, Value::Short(vec![26]));
        let of = |more: &[(Tag, Value)]| Exif::parse(&exif(more, true));
        let phone = of(&[film.clone(), taken[0].clone(), taken[1].clone()]);
        near(phone.focal(4000.0, 3000.0), 26.0 / FILM_DIAGONAL * 5000.0);
        // Made smaller since: fewer pixels, the same view.
        near(phone.focal(1000.0, 750.0), 26.0 / FILM_DIAGONAL * 1250.0);
        // Cut since: nobody knows.
        assert_eq!(phone.focal(4000.0, 1000.0), None);
        // Without the size as taken it is the stored one.
        near(of(std::slice::from_ref(&film)).focal(400.0, 300.0), 26.0 / FILM_DIAGONAL * 500.0);
        // A sensor's pixels: 50 mm at 4000 pixels an inch, or a centimetre.
        let sensor = |unit: u16| {
            let lens = [
                (Tag::FocalLength, rational(50, 1)),
                (Tag::FocalPlaneXResolution, rational(4000, 1)),
                (Tag::FocalPlaneResolutionUnit, Value::Short(vec![unit])),
            ];
            of(&[&lens[..], &taken[..]].concat())
        };
        near(sensor(2).focal(2000.0, 1500.0), 50.0 / 25.4 * 4000.0 / 2.0);
        near(sensor(3).focal(4000.0, 3000.0), 50.0 / 10.0 * 4000.0);
        for none in [Value::Short(vec![0]), Value::Short(vec![1]), Value::Ascii(vec![b"26".to_vec()])] {
            let found = of(&[(Tag::FocalLengthIn35mmFilm, none.clone())]).focal(400.0, 300.0);
            assert_eq!(found, None, "{none:?}");
        }
    }
}
