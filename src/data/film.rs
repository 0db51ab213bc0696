//! Films, by way of `ffmpeg` where it is installed: into a folder of frames, which is read like any other
//! ([`frames`](super::frames)), and of frames into a film.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::UNIX_EPOCH;

use crate::formats::atomic::write_bytes_atomically;
use crate::{Error, Result};

/// Frames a second that are taken out for training: between frames of 30 a second a car hardly moves.
pub const FPS: f64 = 10.0;
/// Endings of films.
const ENDINGS: [&str; 8] = ["mp4", "mov", "m4v", "mkv", "webm", "avi", "mpg", "3gp"];
/// The file in a folder of frames that says of which film they are.
const ORIGIN: &str = ".film";

/// Whether a path is a file with the ending of a film.
pub fn is_film(path: &Path) -> bool {
    let ending = path.extension().and_then(OsStr::to_str).map(str::to_ascii_lowercase);
    path.is_file() && ending.is_some_and(|ending| ENDINGS.contains(&ending.as_str()))
}

/// The folder beside a film in which its frames lie: `drive.mp4` at 10 frames a second in `drive.10fps`.
pub fn folder_of(film: &Path, fps: f64) -> PathBuf {
    film.with_extension(format!("{fps}fps"))
}

/// Takes the frames out of a film, `fps` of them a second, upright as the film says, into a folder of JPEGs that is new
/// (`000001.jpg` and so on); where that has been done already, nothing. How many frames there are.
///
/// # Errors
/// If ffmpeg is not installed or cannot read the film; if the folder holds something else, or the frames of what the
/// film was before it changed.
pub fn take_frames(film: &Path, fps: f64, folder: &Path) -> Result<usize> {
    if !(fps > 0.0 && fps <= 1000.0) {
        return Err(Error::setting("fps", format!("{fps} is not a number of frames a second above 0, up to 1000")));
    }
    let origin = origin(film, fps)?;
    if folder.exists() {
        return match fs::read_to_string(folder.join(ORIGIN)) {
            Ok(found) if found == origin => count(folder),
            Ok(_) => {
                let message = "holds frames of this film as it was before, or at another rate: remove the folder (keep its \
                               camera.toml, if you put one there) and start again";
                Err(Error::file(folder, message))
            }
            Err(_) => Err(Error::file(folder, "is in the way of the film's frames: move it, or rename the film")),
        };
    }
    // Made aside and renamed when whole.
    let mut aside = folder.as_os_str().to_owned();
    aside.push(".partial");
    let aside = PathBuf::from(aside);
    if aside.exists() {
        fs::remove_dir_all(&aside).map_err(|e| Error::io(&aside, e))?;
    }
    fs::create_dir_all(&aside).map_err(|e| Error::io(&aside, e))?;
    let rate = format!("fps={fps}");
    let outputs = aside.join("%06d.jpg");
    let arguments: Vec<&OsStr> = ["-i".as_ref(), film.as_os_str(), "-an".as_ref(), "-vf".as_ref(), rate.as_ref()]
        .into_iter()
        .chain(["-qscale:v".as_ref(), "2".as_ref(), outputs.as_os_str()])
        .collect();
    let done = ffmpeg(&arguments, film).and_then(|()| match count(&aside)? {
        0 => Err(Error::file(film, "ffmpeg found no pictures in it: is it a film?")),
        n => {
            write_bytes_atomically(aside.join(ORIGIN), origin.as_bytes())?;
            fs::rename(&aside, folder).map_err(|e| Error::io(folder, e))?;
            Ok(n)
        }
    });
    if done.is_err() {
        // What is left of it is of no use; if it cannot go, the error above says what matters.
        let _ = fs::remove_dir_all(&aside);
    }
    done
}

/// Makes a film of pictures, shown `fps` a second in the given order. Its ending says its format; one that is there is
/// replaced when the new one is whole.
///
/// # Errors
/// If ffmpeg is not installed or cannot write it.
pub fn make_film(pictures: &[PathBuf], fps: f64, film: &Path) -> Result<()> {
    let name = film.file_name().unwrap_or_default();
    let beside = |prefix: &str, ending: &str| {
        let mut file = OsString::from(prefix);
        file.push(name);
        file.push(ending);
        film.with_file_name(file)
    };
    // The list and the film that grows stand beside it, hidden; the ending stays, which says the format.
    let (list, aside) = (beside(".list-of-", ".txt"), beside(".partial-", ""));
    let mut text = String::from("ffconcat version 1.0\n");
    for picture in pictures {
        let path = std::path::absolute(picture).map_err(|e| Error::io(picture, e))?;
        let path = path.to_str().ok_or_else(|| Error::file(&path, "a film takes paths in UTF-8 alone"))?;
        text += &format!("file '{}'\n", path.replace('\'', "'\\''"));
    }
    write_bytes_atomically(&list, text.as_bytes())?;
    // The time of a picture is its number over the rate; sides are even, as most players want.
    let filter = format!("setpts=N/{fps}/TB,pad=ceil(iw/2)*2:ceil(ih/2)*2");
    let rate = fps.to_string();
    let arguments: Vec<&OsStr> = ["-y", "-f", "concat", "-safe", "0", "-i"]
        .map(OsStr::new)
        .into_iter()
        .chain([list.as_os_str(), "-vf".as_ref(), filter.as_ref(), "-r".as_ref(), rate.as_ref()])
        .chain(["-pix_fmt".as_ref(), "yuv420p".as_ref()])
        .chain([aside.as_os_str()])
        .collect();
    let done = ffmpeg(&arguments, film).and_then(|()| fs::rename(&aside, film).map_err(|e| Error::io(film, e)));
    for left in [list, aside] {
        let _ = fs::remove_file(left);
    }
    done
}

/// Identity of a film, by which its frames are known: its size and time, and the rate.
fn origin(film: &Path, fps: f64) -> Result<String> {
    let data = fs::metadata(film).map_err(|e| Error::io(film, e))?;
    let changed = data.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok()).unwrap_or_default();
    Ok(format!("{} bytes, changed {}, {fps} frames a second\n", data.len(), changed.as_nanos()))
}

/// The number of frames in a folder.
fn count(folder: &Path) -> Result<usize> {
    let entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
    Ok(entries.flatten().filter(|entry| entry.path().extension() == Some(OsStr::new("jpg"))).count())
}

/// Runs ffmpeg, which says nothing but errors.
fn ffmpeg(arguments: &[&OsStr], film: &Path) -> Result<()> {
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-hide_banner", "-v", "error"]).args(arguments);
    let run = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).output();
    let output = run.map_err(|e| match e.kind() {
        ErrorKind::NotFound => Error::file(
            film,
            "films are read and written by ffmpeg, which is not installed: install it (apt install ffmpeg, brew install \
             ffmpeg, winget install ffmpeg), or make a folder of frames elsewhere and give that",
        ),
        _ => Error::io("ffmpeg", e),
    })?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let last: Vec<&str> = said.lines().rev().take(3).collect();
    let last: Vec<&str> = last.into_iter().rev().collect();
    Err(Error::file(film, format!("ffmpeg could not do it ({}): {}", output.status, last.join("; "))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn films_are_told_by_their_ending() {
        let place = tempfile::tempdir().unwrap();
        for (name, film) in [("a.MP4", true), ("b.mov", true), ("c.jpg", false), ("d", false)] {
            fs::write(place.path().join(name), "x").unwrap();
            assert_eq!(is_film(&place.path().join(name)), film, "{name}");
        }
        assert!(!is_film(&place.path().join("none.mp4")));
        assert_eq!(folder_of(Path::new("a/drive.mp4"), 10.0), Path::new("a/drive.10fps"));
        assert_eq!(folder_of(Path::new("drive.mov"), 2.5), Path::new("drive.2.5fps"));
    }

    #[test]
    fn frames_that_are_there_are_taken_and_others_refused() {
        let place = tempfile::tempdir().unwrap();
        let film = place.path().join("drive.mp4");
        fs::write(&film, "not looked at").unwrap();
        let folder = folder_of(&film, FPS);
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("000001.jpg"), "x").unwrap();
        let refused = || take_frames(&film, FPS, &folder).unwrap_err().to_string();
        assert!(refused().contains("drive.10fps: is in the way"), "{}", refused());
        fs::write(folder.join(ORIGIN), origin(&film, FPS).unwrap()).unwrap();
        assert_eq!(take_frames(&film, FPS, &folder).unwrap(), 1);
        fs::write(&film, "another").unwrap();
        assert!(refused().contains("as it was before"), "{}", refused());
        for fps in [0.0, -1.0, f64::NAN] {
            assert!(take_frames(&film, fps, &folder).unwrap_err().to_string().contains("fps"));
        }
    }

    /// With ffmpeg where there is one: a film of coloured pictures has them as its frames; what is none is an error.
    #[test]
    fn a_film_goes_there_and_back_or_the_message_says_what_to_install() {
        let place = tempfile::tempdir().unwrap();
        let broken = place.path().join("broken.mp4");
        fs::write(&broken, "no film at all").unwrap();
        let folder = folder_of(&broken, 5.0);
        let error = take_frames(&broken, 5.0, &folder).unwrap_err().to_string();
        assert!(error.contains("broken.mp4") && error.contains("ffmpeg"), "{error}");
        assert!(!folder.exists() && !place.path().join("broken.5fps.partial").exists(), "nothing is left");
        if error.contains("not installed") {
            return println!("ffmpeg is not installed: its message is tested, and no film");
        }
        let colours = [[220, 30, 30], [30, 200, 30], [30, 30, 220], [200, 200, 40]];
        let pictures: Vec<PathBuf> = (0..4).map(|i| place.path().join(format!("it's {i}.png"))).collect();
        for (path, colour) in pictures.iter().zip(colours) {
            image::RgbImage::from_pixel(63, 48, image::Rgb(colour)).save(path).unwrap();
        }
        let film = place.path().join("film.mp4");
        make_film(&pictures, 5.0, &film).unwrap();
        let folder = folder_of(&film, 5.0);
        let count = take_frames(&film, 5.0, &folder).unwrap();
        assert_eq!(count, 4);
        for (i, colour) in colours.into_iter().enumerate() {
            let frame = image::open(folder.join(format!("{:06}.jpg", i + 1))).unwrap().into_rgb8();
            assert_eq!(frame.dimensions(), (64, 48));
            let pixel = frame.get_pixel(20, 20).0;
            assert!(pixel.iter().zip(colour).all(|(&a, b): (&u8, u8)| a.abs_diff(b) < 25), "{pixel:?} {colour:?}");
        }
        assert_eq!(take_frames(&film, 5.0, &folder).unwrap(), count, "a second time nothing is done");
        let hidden =
            fs::read_dir(place.path()).unwrap().flatten().filter(|e| e.file_name().to_string_lossy().starts_with('.'));
        assert_eq!(hidden.count(), 0);
    }
}
