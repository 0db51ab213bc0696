use std::fs;

use super::record::Record;
use super::{leave, page, tell_apart};

/// A run with two steps, a validation, a warning and a snapshot, whose log ends in half a line.
fn run(steps: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let log = "{\"step\":1,\"loss\":0.5,\"flow\":1.0}\n{\"step\":2,\"loss\":null,\"flow\":1.0}\n\
         {\"step\":3,\"loss\":0.25,\"flow\":1.0}\n{\"validated\":3,\"photometric\":0.125,\"abs_rel\":0.1875}\n{\"st";
    fs::write(folder.path().join("log.jsonl"), log).unwrap();
    let warning = r#"{"step":3,"warning":"disparity collapsed","begins":true,"figure":0.01,"limit":0.02}"#;
    fs::write(folder.path().join("warnings.jsonl"), warning).unwrap();
    let config = format!("steps = {steps}\ndata = \"/home/somebody/<frames>\"\n[loss]\nssim = 0.85\n");
    fs::write(folder.path().join("config.toml"), config).unwrap();
    fs::create_dir(folder.path().join("pages")).unwrap();
    image::RgbImage::new(32, 32).save(folder.path().join("pages/0000003-0.jpg")).unwrap();
    folder
}

#[test]
fn the_page_shows_what_can_be_read_and_names_the_rest() {
    let folder = run("3");
    leave(folder.path(), true);
    let page = fs::read_to_string(folder.path().join("report.html")).unwrap();
    for expected in [
        "the last line of log.jsonl is torn",
        "being trained: step 3 of 3",
        "the depth network predicts the same depth",
        "0.1875",
        "…/&lt;frames&gt;",
        "data-step=\"3\"",
        "data:image/jpeg;base64,",
        "loss.ssim",
    ] {
        assert!(page.contains(expected), "{expected}");
    }
    // Nothing from elsewhere, and no names.
    for refused in ["somebody", "<frames>", "src=\"http", "href=\"http", "@import", "NaN"] {
        assert!(!page.contains(refused), "{refused}");
    }
}

#[test]
fn several_runs_are_compared_and_their_differences_listed() {
    let (one, other) = (run("3"), run("7"));
    let mut runs = [Record::read(one.path()).unwrap(), Record::read(other.path()).unwrap()];
    runs.iter_mut().for_each(|run| run.name = "same".into());
    tell_apart(&mut runs);
    let page = page::page(&runs, false, &["gone is left out".into()]);
    assert!(page.contains("same (1)") && page.contains("same (2)") && page.contains("gone is left out"));
    let table = page.split("Differences of the configurations</caption>").nth(1).unwrap();
    let table = table.split("</table>").next().unwrap();
    assert!(table.contains("<td>3</td><td>7</td>") && !table.contains("loss.ssim"), "{table}");
}

#[test]
fn a_folder_without_a_run_is_refused_and_one_without_a_log_is_shown() {
    let folder = tempfile::tempdir().unwrap();
    let error = Record::read(folder.path()).err().unwrap().to_string();
    assert!(error.contains("log.jsonl or config.toml"), "{error}");
    fs::write(folder.path().join("config.toml"), "steps = 3\n").unwrap();
    let run = Record::read(folder.path()).unwrap();
    assert!(page::page(&[run], false, &[]).contains("there is no log.jsonl"));
}

#[test]
fn views_are_shown_and_none_is_read_from_outside() {
    let folder = run("3");
    let place = folder.path().join("views");
    fs::create_dir(&place).unwrap();
    image::RgbImage::new(8, 8).save(place.join("error.png")).unwrap();
    image::RgbImage::new(8, 8).save(folder.path().join("outside.png")).unwrap();
    let list = r#"{"step":3,"time":[["conv2d",0.003],["warp",0.001]],"path":[[0,0],[0.5,2]],"metres":true,"groups":[
        {"kind":"Depth and its error","about":"<frame>","views":[
            {"file":"error.png","title":"Error","bar":["0","50 % and more"]},{"file":"../outside.png","title":"Outside"}]}]}"#;
    fs::write(place.join("validation.json"), list).unwrap();
    fs::write(place.join("end.json"), "3").unwrap();
    let run = Record::read(folder.path()).unwrap();
    let page = page::page(&[run], false, &[]);
    let expected = [
        "data:image/png;base64,",
        "50 % and more",
        "&lt;frame&gt;",
        "<td>75.0 %</td>",
        "ends 0.5 to the right and 2.0 ahead (m)",
        "1 pictures cannot be read",
        "views/end.json is none of this version",
    ];
    for expected in expected {
        assert!(page.contains(expected), "{expected}");
    }
    assert!(!page.contains("Outside"));
}
