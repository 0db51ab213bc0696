//! Which pictures the arguments of a command mean, in which order, and what is made of each is called.

use std::cmp::Ordering;
use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// What pictures in a folder end in.
pub(super) const ENDINGS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// A picture to read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Input {
    /// Where it is.
    pub path: PathBuf,
    /// The picture's path below the folder that it was found in, without its ending: `b/frame7` for `a/b/frame7.png`
    /// of the folder `a`. Where several inputs are given, a folder's own name stands in front: `a/b/frame7`.
    pub name: PathBuf,
}

/// The pictures that were found, and what lies among them that is none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Found {
    /// The pictures, in order; no two have one name.
    pub pictures: Vec<Input>,
    /// The other files in the folders, but for hidden ones.
    pub skipped: Vec<PathBuf>,
}

/// The pictures that `inputs` mean: files as they are given, and all PNG, JPEG and WebP files in folders and the
/// folders inside them, in the order in which people number them. Hidden files and folders, links to folders, and `out`
/// (where results go) are passed over.
///
/// A file is not looked at: that it is missing, or is no picture, is found out when it is read.
///
/// # Errors
/// If a folder cannot be read, holds no picture, or is `out` itself.
pub fn find_pictures(inputs: &[PathBuf], out: &Path) -> Result<Found> {
    // A folder that does not exist yet holds no results.
    let out = fs::canonicalize(out).ok();
    let (mut all, mut skipped) = (Vec::new(), Vec::new());
    for input in inputs {
        if !input.is_dir() {
            let name = input.file_stem().ok_or_else(|| Error::file(input, "expected a picture or a folder"))?;
            all.push(Input { path: input.clone(), name: name.into() });
            continue;
        }
        let root = fs::canonicalize(input).map_err(|e| Error::io(input, e))?;
        if Some(&root) == out.as_ref() {
            let message = "results are not written among the pictures of a folder: give another --out";
            return Err(Error::file(input, message));
        }
        let (mut inside, mut others) = (Vec::new(), Vec::new());
        walk(input, Path::new(""), out.as_deref(), &mut inside, &mut others)?;
        if inside.is_empty() {
            let others = match others.len() {
                0 => String::new(),
                n => format!(", but {n} other files, such as {}", others[0].display()),
            };
            return Err(Error::file(input, format!("holds no PNG, JPEG or WebP pictures{others}")));
        }
        others.sort_by(|a, b| natural_order_of_paths(a, b));
        skipped.extend(others.into_iter().map(|other| input.join(other)));
        inside.sort_by(|a, b| natural_order_of_paths(a, b));
        let own =
            if inputs.len() > 1 { root.file_name().map(PathBuf::from).unwrap_or_default() } else { PathBuf::new() };
        let picture = |inside: PathBuf| Input { path: input.join(&inside), name: own.join(inside.with_extension("")) };
        all.extend(inside.into_iter().map(picture));
    }
    Ok(Found { pictures: with_names_of_their_own(all), skipped })
}

/// Gives pictures of one name their endings back, and the folders that they lie in as far as that is needed; what is given
/// twice is one picture.
fn with_names_of_their_own(pictures: Vec<Input>) -> Vec<Input> {
    let mut paths = HashSet::new();
    let same = |input: &Input| fs::canonicalize(&input.path).unwrap_or_else(|_| input.path.clone());
    let mut pictures: Vec<Input> = pictures.into_iter().filter(|input| paths.insert(same(input))).collect();
    // Case is no difference to some file systems.
    let key = |name: &Path| name.to_string_lossy().to_lowercase();
    let clashes = |pictures: &[Input]| -> HashSet<String> {
        let (mut seen, mut twice) = (HashSet::new(), HashSet::new());
        for input in pictures {
            if !seen.insert(key(&input.name)) {
                twice.insert(key(&input.name));
            }
        }
        twice
    };
    let shared = clashes(&pictures);
    for input in pictures.iter_mut().filter(|input| shared.contains(&key(&input.name))) {
        if let Some(ending) = input.path.extension() {
            let mut name = input.name.clone().into_os_string();
            name.push(".");
            name.push(ending);
            input.name = name.into();
        }
    }
    for above in 1.. {
        let shared = clashes(&pictures);
        if shared.is_empty() {
            break;
        }
        let mut changed = false;
        for input in pictures.iter_mut().filter(|input| shared.contains(&key(&input.name))) {
            let path = same(input);
            let folder = path.ancestors().nth(input.name.components().count() + above - 1).and_then(Path::file_name);
            if let Some(folder) = folder {
                input.name = Path::new(folder).join(&input.name);
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    pictures
}

/// Adds the pictures below `root/inside` to `found`, and all other files to `others`, as paths below `root`.
fn walk(
    root: &Path,
    inside: &Path,
    out: Option<&Path>,
    found: &mut Vec<PathBuf>,
    others: &mut Vec<PathBuf>,
) -> Result<()> {
    let folder = root.join(inside);
    if out.is_some() && fs::canonicalize(&folder).ok().as_deref() == out {
        return Ok(());
    }
    for entry in fs::read_dir(&folder).map_err(|e| Error::io(&folder, e))? {
        let entry = entry.map_err(|e| Error::io(&folder, e))?;
        let kind = entry.file_type().map_err(|e| Error::io(entry.path(), e))?;
        let name = entry.file_name();
        if name.as_encoded_bytes().starts_with(b".") {
            continue;
        }
        let path = inside.join(name);
        // Links to folders are not followed: they may lead in circles.
        if kind.is_dir() {
            walk(root, &path, out, found, others)?;
        } else if entry.path().is_file() {
            if is_picture(&path) { found.push(path) } else { others.push(path) }
        }
    }
    Ok(())
}

fn is_picture(path: &Path) -> bool {
    path.extension().is_some_and(|e| ENDINGS.iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// Compares names as people number them: a run of digits counts as one number, so `frame2` comes before `frame10`.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let (pieces_a, pieces_b) = (pieces(a), pieces(b));
    let differing = pieces_a.iter().zip(&pieces_b).map(|(a, b)| order_of_pieces(a, b)).find(|o| o.is_ne());
    // `7` and `007` are one number but two names.
    differing.unwrap_or_else(|| pieces_a.len().cmp(&pieces_b.len()).then_with(|| a.cmp(b)))
}

/// Runs of digits, and what lies between them.
fn pieces(name: &str) -> Vec<&[u8]> {
    name.as_bytes().chunk_by(|a, b| a.is_ascii_digit() == b.is_ascii_digit()).collect()
}

fn order_of_pieces(a: &[u8], b: &[u8]) -> Ordering {
    if !(a[0].is_ascii_digit() && b[0].is_ascii_digit()) {
        return a.cmp(b);
    }
    // Of numbers without leading zeros the longer one is larger; numbers of any length fit.
    let digits = |piece: &'_ [u8]| piece.iter().position(|&d| d != b'0').unwrap_or(piece.len());
    let (a, b) = (&a[digits(a)..], &b[digits(b)..]);
    a.len().cmp(&b.len()).then_with(|| a.cmp(b))
}

pub(super) fn natural_order_of_paths(a: &Path, b: &Path) -> Ordering {
    let names = |path: &Path| path.iter().map(|n| n.to_string_lossy().into_owned()).collect::<Vec<_>>();
    let (a, b) = (names(a), names(b));
    let differing = a.iter().zip(&b).map(|(a, b)| natural_order(a, b)).find(|o| o.is_ne());
    differing.unwrap_or_else(|| a.len().cmp(&b.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        folder
    }

    fn names(inputs: &[PathBuf], out: &Path) -> Vec<String> {
        let found = find_pictures(inputs, out).unwrap();
        found.pictures.iter().map(|i| i.name.to_str().unwrap().replace('\\', "/")).collect()
    }

    #[test]
    fn numbers_count_as_people_count() {
        let sorted =
            ["a", "a1", "a2", "a02", "a2b", "a10", "a99999999999999999999998", "a99999999999999999999999", "b1"];
        let mut shuffled = sorted.to_vec();
        for _ in 0..4 {
            shuffled.rotate_left(2);
            shuffled.swap(1, 5);
            let mut again = shuffled.clone();
            again.sort_by(|a, b| natural_order(a, b));
            // `a02` and `a2` are the same number: the order of their characters decides.
            let mut expected = sorted;
            expected.swap(2, 3);
            assert_eq!(again, expected);
        }
        assert_eq!(natural_order("frame7.png", "frame7.png"), Ordering::Equal);
        assert_eq!(natural_order("", "a"), Ordering::Less);
    }

    #[test]
    fn a_folder_means_the_pictures_below_it_in_order_and_keeps_their_names() {
        let files =
            ["f10.png", "f2.JPG", "f1.webp", "notes.txt", ".hidden.png", ".git/a.png", "b/f3.jpeg", "b/v1.2.png"];
        let folder = folder(&files);
        let out = folder.path().join("out");
        let folders = [folder.path().to_owned()];
        assert_eq!(names(&folders, &out), ["b/f3", "b/v1.2", "f1", "f2", "f10"]);
        // What a first run left in a folder inside is no picture of the second.
        fs::create_dir(&out).unwrap();
        fs::write(out.join("f1_disp.png"), "").unwrap();
        assert_eq!(names(&folders, &out).len(), 5);
        assert_eq!(names(&folders, Path::new("elsewhere")).len(), 6);
    }

    #[test]
    fn folders_among_several_inputs_stand_under_their_own_names() {
        let folder = folder(&["left/0.png", "right/0.png", "0.png"]);
        let path = |name: &str| folder.path().join(name);
        let inputs = [path("left"), path("right/"), path("0.png")];
        assert_eq!(names(&inputs, &path("out")), ["left/0", "right/0", "0"]);
        assert_eq!(names(&inputs[..1], &path("out")), ["0"]);
    }

    #[test]
    fn folders_that_cannot_serve_are_named() {
        let folder = folder(&["notes.txt", "a/1.png"]);
        fs::remove_file(folder.path().join("a/1.png")).unwrap();
        let inputs = [folder.path().to_owned()];
        let error = find_pictures(&inputs, Path::new("elsewhere")).unwrap_err().to_string();
        assert!(error.contains("holds no PNG"), "{error}");
        fs::write(folder.path().join("a/1.png"), "").unwrap();
        let error = find_pictures(&inputs, folder.path()).unwrap_err().to_string();
        assert!(error.contains("another --out"), "{error}");
        assert!(find_pictures(&[PathBuf::new()], Path::new("elsewhere")).is_err());
    }
}
