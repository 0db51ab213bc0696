use std::fs;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::*;
use crate::data::{DataSource, Opening, open_folder};

const SIZE: [usize; 2] = [6, 9];

/// Two sequences of pictures in two formats, and depth that is no frame.
fn folder() -> tempfile::TempDir {
    let place = tempfile::tempdir().unwrap();
    for (sequence, ending) in [("a", "png"), ("b/c", "jpg")] {
        fs::create_dir_all(place.path().join(sequence).join("depth")).unwrap();
        for frame in 0..5u32 {
            let pixel = |x: u32, y: u32| image::Rgb([(9 * x + frame) as u8, (20 * y) as u8, (x * y + 7 * frame) as u8]);
            let picture = RgbImage::from_fn(24, 16, pixel);
            picture.save(place.path().join(format!("{sequence}/{frame}.{ending}"))).unwrap();
            picture.save(place.path().join(format!("{sequence}/depth/{frame}.png"))).unwrap();
        }
    }
    fs::write(place.path().join("camera.toml"), "fov = 70").unwrap();
    place
}

fn prepared(root: &Path) -> Result<Outcome> {
    prepare(root, SIZE, None, &|_, _| ())
}

fn open(root: &Path) -> Result<std::sync::Arc<dyn DataSource>> {
    open_folder(root, Opening::of(SIZE))
}

fn all_frames(data: &dyn DataSource) -> Vec<RgbImage> {
    let offsets = (0..data.len()).flat_map(|sample| [-1, 0, 1].map(|offset| (sample, offset)));
    offsets.map(|(sample, offset)| data.image(sample, offset).unwrap().as_ref().clone()).collect()
}

fn refusal(root: &Path) -> String {
    let error = open(root).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("frames-9x6.prepared"), "{error}");
    error
}

#[test]
fn prepared_frames_are_those_of_the_files_to_the_bit() {
    let place = folder();
    let plain = all_frames(open(place.path()).unwrap().as_ref());
    let (calls, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let progress = |done: usize, all: usize| {
        assert_eq!(all, 10);
        calls.fetch_add(1, Ordering::Relaxed);
        most.fetch_max(done, Ordering::Relaxed);
    };
    let outcome = prepare(place.path(), SIZE, None, &progress).unwrap();
    assert_eq!((outcome.frames, outcome.kept, outcome.unreadable.len()), (10, 0, 0));
    assert_eq!((calls.into_inner(), most.into_inner()), (10, 10));
    assert_eq!(fs::metadata(&outcome.path).unwrap().len(), outcome.bytes);
    assert_eq!(all_frames(open(place.path()).unwrap().as_ref()), plain);
    // That they come from the file: one that is damaged there is noticed.
    let mut bytes = fs::read(&outcome.path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&outcome.path, bytes).unwrap();
    let data = open(place.path()).unwrap();
    let error = data.image(data.len() - 1, 1).unwrap_err().to_string();
    assert!(error.contains("prepared") && error.contains("4.jpg") && error.contains("damaged"), "{error}");
    assert!(data.image(0, 0).is_ok());
    // Pictures of another size are read from the files.
    assert_eq!(open_folder(place.path(), Opening::of([8, 12])).unwrap().len(), 6);
}

#[test]
fn a_file_elsewhere_is_used_when_it_is_named() {
    let (place, elsewhere) = (folder(), tempfile::tempdir().unwrap());
    let file = elsewhere.path().join("below/mine.frames");
    prepare(place.path(), SIZE, Some(&file), &|_, _| ()).unwrap();
    assert!(!place.path().join(file_name(SIZE)).exists());
    let open = || open_folder(place.path(), Opening { prepared: Some(&file), ..Opening::of(SIZE) });
    assert_eq!(all_frames(open().unwrap().as_ref()).len(), 18);
    fs::remove_file(place.path().join("a/4.png")).unwrap();
    let error = open().map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("mine.frames") && error.contains("a/4.png is gone"), "{error}");
}

#[test]
fn a_preparation_that_was_stopped_goes_on() {
    let place = folder();
    let outcome = prepared(place.path()).unwrap();
    let whole = fs::read(&outcome.path).unwrap();
    let again = prepared(place.path()).unwrap();
    assert_eq!((again.frames, again.kept), (10, 10));
    // As it is left behind: without one frame, and with another half written.
    let mut file = File::open(&outcome.path).unwrap();
    let layout = Layout::read(&mut file, &outcome.path).unwrap();
    let mut bytes = whole.clone();
    let (entry, frame) = (layout.entry_at(3) as usize, layout.frame_at(7) as usize);
    bytes[entry..entry + 8].fill(0);
    bytes[frame + 80..frame + 162].fill(0);
    let partial = place.path().join(".frames-9x6.prepared.partial");
    fs::write(&partial, bytes).unwrap();
    fs::remove_file(&outcome.path).unwrap();
    let again = prepared(place.path()).unwrap();
    assert_eq!((again.frames, again.kept), (10, 8));
    assert!(fs::read(&again.path).unwrap() == whole && !partial.exists());
    // Of other frames nothing is kept.
    fs::rename(&outcome.path, &partial).unwrap();
    fs::remove_file(place.path().join("a/0.png")).unwrap();
    let again = prepared(place.path()).unwrap();
    assert_eq!((again.frames, again.kept), (9, 0));
}

#[test]
fn frames_that_changed_make_it_stale_and_preparing_again_mends_that() {
    let place = folder();
    let root = place.path();
    prepared(root).unwrap();
    fs::copy(root.join("a/1.png"), root.join("a/5.png")).unwrap();
    assert!(refusal(root).contains("a/5.png was added"));
    fs::remove_file(root.join("a/5.png")).unwrap();
    assert!(open(root).is_ok());
    // The same bytes at another time.
    let file = File::options().append(true).open(root.join("b/c/2.jpg")).unwrap();
    file.set_modified(std::time::UNIX_EPOCH + std::time::Duration::from_secs(1)).unwrap();
    assert!(refusal(root).contains("b/c/2.jpg was changed"));
    fs::remove_file(root.join("a/0.png")).unwrap();
    assert!(refusal(root).contains("a/0.png is gone"));
    assert_eq!(prepared(root).unwrap().frames, 9);
    assert!(open(root).is_ok());
}

#[test]
fn other_versions_sizes_and_what_is_cut_off_or_lies_are_refused() {
    let place = folder();
    let path = prepared(place.path()).unwrap().path;
    let whole = fs::read(&path).unwrap();
    let with = |at: usize, bytes: &[u8]| {
        let mut changed = whole.clone();
        changed[at..at + bytes.len()].copy_from_slice(bytes);
        changed
    };
    for (bytes, what) in [
        (with(8, &1u32.to_le_bytes()), "version 1"),
        (with(0, b"X"), "no file of prepared frames"),
        (whole[..20].to_vec(), "no file of prepared frames"),
        (whole[..whole.len() - 1].to_vec(), "bytes, which are not those of 10 frames of 9x6"),
        (whole[..60].to_vec(), "cut off"),
        (with(24, &u64::MAX.to_le_bytes()), "cut off"),
        (with(20, &u32::MAX.to_le_bytes()), "cut off"),
        (with(50, b"?"), "list of frames is damaged"),
        (with(12, &8u32.to_le_bytes()), "list of frames is damaged"),
    ] {
        fs::write(&path, bytes).unwrap();
        let error = refusal(place.path());
        assert!(error.contains(what), "{what}: {error}");
        assert!(error.contains("data prepare"), "{error}");
    }
    fs::write(&path, &whole).unwrap();
    let error = Prepared::open(&path, place.path(), [6, 10]).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("frames of 9x6, where 10x6 are needed"), "{error}");
    // What is no good is made anew.
    fs::write(&path, &whole[..60]).unwrap();
    assert_eq!(prepared(place.path()).unwrap().kept, 0);
    assert!(fs::read(&path).unwrap() == whole);
}

#[test]
fn a_folder_that_changes_meanwhile_and_a_disk_that_is_full_leave_no_file() {
    let place = folder();
    let root = place.path();
    let once = AtomicBool::new(false);
    let change = |_: usize, _: usize| {
        if !once.swap(true, Ordering::SeqCst) {
            fs::copy(root.join("a/1.png"), root.join("a/9.png")).unwrap();
        }
    };
    let error = prepare(root, SIZE, None, &change).unwrap_err().to_string();
    assert!(error.contains("a/9.png was added") && error.contains("changed while"), "{error}");
    assert!(!root.join(file_name(SIZE)).exists());
    #[cfg(target_os = "linux")]
    {
        let partial = root.join(".frames-9x6.prepared.partial");
        fs::remove_file(&partial).unwrap();
        std::os::unix::fs::symlink("/dev/full", &partial).unwrap();
        let error = prepared(root).unwrap_err().to_string();
        assert!(error.contains("frames-9x6.prepared") && error.contains("No space left"), "{error}");
        assert!(!root.join(file_name(SIZE)).exists());
    }
}

#[test]
fn frames_that_cannot_be_read_are_named_and_met_again_in_training() {
    let place = folder();
    fs::write(place.path().join("a/2.png"), &fs::read(place.path().join("a/2.png")).unwrap()[..60]).unwrap();
    let outcome = prepared(place.path()).unwrap();
    assert_eq!((outcome.frames, outcome.unreadable.len()), (9, 1));
    assert!(outcome.unreadable[0].1.contains("2.png"), "{:?}", outcome.unreadable);
    let data = open(place.path()).unwrap();
    assert!(data.image(0, 1).unwrap_err().to_string().contains("2.png"));
    assert!(data.image(0, 0).is_ok());
}

#[test]
fn two_preparations_at_once_and_places_that_cannot_be_are_refused() {
    let place = folder();
    let partial = place.path().join(".frames-9x6.prepared.partial");
    let held = File::create(&partial).unwrap();
    held.try_lock().unwrap();
    let error = prepared(place.path()).unwrap_err().to_string();
    assert!(error.contains("another process"), "{error}");
    drop(held);
    assert_eq!(prepared(place.path()).unwrap().frames, 10);
    let out = place.path().join("a");
    let error = prepare(place.path(), SIZE, Some(&out), &|_, _| ()).unwrap_err().to_string();
    assert!(error.contains("is a folder"), "{error}");
    assert!(prepare(&place.path().join("nowhere"), SIZE, None, &|_, _| ()).is_err());
    assert!(prepare(place.path(), [0, 9], None, &|_, _| ()).is_err());
}
