//! The camera of a picture: what the flags say, a `camera.toml` beside it, its EXIF data, or else KITTI's.

use std::path::{Path, PathBuf};

use parallax::Result;
use parallax::camera::Intrinsics;
use parallax::data::camera::told_beside;
use serde::Serialize;

/// Whose word on a picture's camera was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Told {
    /// `--fov` or `--intrinsics`.
    Flag,
    /// A `camera.toml`.
    CameraToml,
    /// The picture's own EXIF data.
    Exif,
    /// Nobody's: KITTI's camera is assumed.
    Assumed,
}

/// A picture's camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    pub intrinsics: Intrinsics,
    pub told: Told,
}

impl Lens {
    /// The view across, in degrees.
    pub fn view(&self) -> f64 {
        2.0 * (0.5 / self.intrinsics.fx).atan().to_degrees()
    }
}

/// The flags that say which camera took pictures.
#[derive(Clone, Copy, Debug, Default)]
pub struct Flags {
    /// fx, fy, cx, cy in pixels of the pictures.
    pub intrinsics: Option<[f64; 4]>,
    /// Degrees across.
    pub fov: Option<f64>,
}

impl Flags {
    /// The camera of a picture of `width x height` pixels, whose EXIF data tell a focal length of `focal` pixels. A
    /// `camera.toml` is looked for from the picture's folder up to that of the `inputs` which it was found in.
    ///
    /// # Errors
    /// If the `camera.toml` beside it cannot be read, or does not fit the picture.
    pub fn lens(self, inputs: &[PathBuf], picture: &Path, size: [f64; 2], focal: Option<f64>) -> Result<Lens> {
        let alone = self.lens_alone(size, focal);
        match alone.told {
            Told::Flag => Ok(alone),
            _ => Ok(match told_beside(picture, root(inputs, picture), size)? {
                Some(intrinsics) => Lens { intrinsics, told: Told::CameraToml },
                None => alone,
            }),
        }
    }

    /// [`lens`](Flags::lens) of a picture that lies in no folder.
    pub fn lens_alone(self, [width, height]: [f64; 2], focal: Option<f64>) -> Lens {
        let of = |[fx, fy, cx, cy]: [f64; 4], told: Told| Lens {
            intrinsics: Intrinsics { fx: fx / width, fy: fy / height, cx: cx / width, cy: cy / height },
            told,
        };
        // Square pixels around the middle.
        let centred = |focal: f64, told: Told| of([focal, focal, (width - 1.0) / 2.0, (height - 1.0) / 2.0], told);
        match (self, focal) {
            (Flags { intrinsics: Some(pixels), .. }, _) => of(pixels, Told::Flag),
            (Flags { fov: Some(fov), .. }, _) => centred(0.5 * width / (fov / 2.0).to_radians().tan(), Told::Flag),
            (_, Some(focal)) => centred(focal, Told::Exif),
            _ => centred(Intrinsics::KITTI.fx * width, Told::Assumed),
        }
    }
}

/// The folder among the inputs that a picture lies in; its own folder if it was given itself.
fn root<'a>(inputs: &'a [PathBuf], picture: &'a Path) -> &'a Path {
    let folders = inputs.iter().filter(|input| *input != picture && picture.starts_with(input));
    let own = || picture.parent().unwrap_or(Path::new(""));
    folders.map(PathBuf::as_path).min_by_key(|input| input.components().count()).unwrap_or_else(own)
}

/// The views of pictures in words, such as `67.4 degrees across by EXIF (12 pictures)`; nothing if the flags told.
pub fn in_words(lenses: &[(Told, f64)]) -> Option<String> {
    let mut kinds: Vec<(Told, f64, usize)> = Vec::new();
    for &(told, view) in lenses.iter().filter(|(told, _)| *told != Told::Flag) {
        let view = (10.0 * view).round() / 10.0;
        match kinds.iter_mut().find(|kind| (kind.0, kind.1) == (told, view)) {
            Some(kind) => kind.2 += 1,
            None => kinds.push((told, view, 1)),
        }
    }
    let all = kinds.len();
    let said = kinds.iter().take(4).map(|(told, view, count)| {
        let whose = match told {
            Told::Flag => "by the flags",
            Told::CameraToml => "by camera.toml",
            Told::Exif => "by EXIF",
            Told::Assumed => "assumed, for want of --fov, camera.toml or EXIF data",
        };
        let plural = if *count == 1 { "" } else { "s" };
        format!("{view:.1} degrees across {whose} ({count} picture{plural})")
    });
    let mut said: Vec<String> = said.collect();
    if all > said.len() {
        said.push(format!("and {} other views", all - said.len()));
    }
    (all > 0).then(|| said.join("; "))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn flags_come_before_the_file_the_file_before_exif_and_kitti_last() {
        let folder = tempfile::tempdir().unwrap();
        let (outer, inner) = (folder.path().join("a"), folder.path().join("a/b"));
        fs::create_dir_all(&inner).unwrap();
        let picture = inner.join("c.jpg");
        let lens = |flags: Flags, input: &Path, focal: Option<f64>| {
            flags.lens(&[input.to_owned()], &picture, [400.0, 300.0], focal)
        };
        let none = Flags::default();
        let is = |lens: Lens, told: Told, fx: f64| {
            assert!(lens.told == told && (lens.intrinsics.fx - fx).abs() < 1e-9, "{lens:?}, expected {told:?} {fx}");
        };
        is(lens(none, &outer, None).unwrap(), Told::Assumed, 0.58);
        is(lens(none, &outer, Some(300.0)).unwrap(), Told::Exif, 0.75);
        fs::write(outer.join("camera.toml"), "fov = 90").unwrap();
        is(lens(none, &outer, Some(300.0)).unwrap(), Told::CameraToml, 0.5);
        // A picture that was given itself looks in its own folder alone.
        is(lens(none, &picture, Some(300.0)).unwrap(), Told::Exif, 0.75);
        is(lens(Flags { fov: Some(90.0), ..none }, &outer, Some(300.0)).unwrap(), Told::Flag, 0.5);
        is(
            lens(Flags { intrinsics: Some([200.0, 210.0, 199.5, 149.5]), ..none }, &outer, None).unwrap(),
            Told::Flag,
            0.5,
        );
        // A file about the layout alone says nothing of the camera; one that does not fit is named.
        fs::write(inner.join("camera.toml"), "frames = \"{}.jpg\"").unwrap();
        is(lens(none, &inner, Some(300.0)).unwrap(), Told::Exif, 0.75);
        let wide = "width = 1242\nheight = 375\nfx = 700\nfy = 700\ncx = 600\ncy = 170";
        fs::write(inner.join("camera.toml"), wide).unwrap();
        let error = lens(none, &inner, None).unwrap_err().to_string();
        assert!(error.contains("camera.toml") && error.contains("aspect"), "{error}");
    }

    #[test]
    fn views_are_said_once_for_each_kind() {
        assert_eq!(in_words(&[(Told::Flag, 90.0)]), None);
        let said = in_words(&[(Told::Exif, 67.38), (Told::Assumed, 81.5), (Told::Exif, 67.42)]).unwrap();
        assert_eq!(
            said,
            "67.4 degrees across by EXIF (2 pictures); 81.5 degrees across assumed, for want of --fov, camera.toml or \
             EXIF data (1 picture)"
        );
        let many: Vec<_> = (0..6).map(|i| (Told::Exif, 60.0 + f64::from(i))).collect();
        assert!(in_words(&many).unwrap().ends_with("and 2 other views"));
    }
}
