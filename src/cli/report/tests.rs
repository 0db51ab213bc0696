use std::fs;

use super::record::Record;
use super::verdict::{Standing, Verdict};
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
        "id=\"again\"",
        "there are no views",
        "there is no machine.json",
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
    let page = page::page(&runs, &["gone is left out".into()]);
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
    assert!(page::page(&[run], &[]).contains("there is no log.jsonl"));
}

#[test]
fn views_are_shown_and_none_is_read_from_outside() {
    let folder = run("3");
    let place = folder.path().join("views");
    fs::create_dir(&place).unwrap();
    image::RgbImage::new(8, 8).save(place.join("error.png")).unwrap();
    image::RgbImage::new(8, 8).save(folder.path().join("outside.png")).unwrap();
    let list = r#"{"step":3,"time":[["conv2d",0.003],["warp",0.001]],"path":[[0,0],[0.5,2]],
        "true_path":[[0,0],[0.4,1.9]],"path_error":0.21,"metres":true,"groups":[
        {"kind":"Depth and its error","about":"<frame>","views":[
            {"file":"error.png","title":"Error","bar":["0","50 % and more"]},{"file":"../outside.png","title":"Outside"}]}]}"#;
    fs::write(place.join("validation.json"), list).unwrap();
    fs::write(place.join("end.json"), "3").unwrap();
    let run = Record::read(folder.path()).unwrap();
    let page = page::page(&[run], &[]);
    let expected = [
        "data:image/png;base64,",
        "50 % and more",
        "&lt;frame&gt;",
        "<td>75.0 %</td>",
        "ends 0.5 to the right and 2.0 ahead (m)",
        "; 0.21 m off on average once laid over the true path",
        ", truly 0.4 to the right and 1.9 ahead (m)",
        "true path",
        "1 pictures cannot be read",
        "views/end.json is none of this version",
    ];
    for expected in expected {
        assert!(page.contains(expected), "{expected}");
    }
    assert!(!page.contains("Outside"));
}

/// A run of two validations whose last line is as given, with the metrics of its end.
fn ended(validation: &str, metrics: &str) -> tempfile::TempDir {
    let folder = run("3");
    let log = format!("{{\"step\":3,\"loss\":0.25,\"flow\":1.0}}\n{validation}\n");
    fs::write(folder.path().join("log.jsonl"), log).unwrap();
    fs::write(folder.path().join("metrics.json"), metrics).unwrap();
    fs::remove_file(folder.path().join("warnings.jsonl")).unwrap();
    folder
}

const METRICS: &str = r#"{"steps":3,"after":{"abs_rel":0.131},"mean_map":{"abs_rel":0.393}}"#;

#[test]
fn verdicts_follow_from_what_was_recorded() {
    let good = r#"{"validated":3,"photometric":0.1,"warped":0.1,"unwarped":0.2,"abs_rel":0.14}"#;
    let healthy = ended(good, METRICS);
    let verdict = Verdict::of(&Record::read(healthy.path()).unwrap());
    assert_eq!((verdict.standing, verdict.figure.unwrap().value), (Standing::Healthy, 0.131));
    assert!(verdict.reasons[1].contains("50 % less"), "{:?}", verdict.reasons);

    let failed = |validation: &str, metrics: &str, words: &str| {
        let folder = ended(validation, metrics);
        let verdict = Verdict::of(&Record::read(folder.path()).unwrap());
        assert!(verdict.standing == Standing::Failed && verdict.reasons[0].contains(words), "{:?}", verdict.reasons);
    };
    failed(r#"{"validated":3,"warped":0.2,"unwarped":0.2}"#, METRICS, "no better than standing still");
    failed(good, r#"{"after":{"abs_rel":0.393},"mean_map":{"abs_rel":0.393}}"#, "no better than one mean depth map");

    // A warning that has ended counts no more; one that stands does, and one of the lesser ones is a doubt.
    let warned = |name: &str, begins: &[bool]| {
        let folder = ended(good, METRICS);
        let line = |begins: &bool| format!("{{\"step\":3,\"warning\":\"{name}\",\"begins\":{begins}}}\n");
        fs::write(folder.path().join("warnings.jsonl"), begins.iter().map(line).collect::<String>()).unwrap();
        Verdict::of(&Record::read(folder.path()).unwrap()).standing
    };
    assert_eq!(warned("disparity collapsed", &[true]), Standing::Failed);
    assert_eq!(warned("disparity collapsed", &[true, false]), Standing::Healthy);
    assert_eq!(warned("rate too high", &[true]), Standing::Doubtful);
    let early = run("3");
    fs::write(early.path().join("warnings.jsonl"), "").unwrap();
    fs::write(early.path().join("log.jsonl"), "{\"step\":1,\"loss\":0.5,\"flow\":1.0}\n").unwrap();
    assert_eq!(Verdict::of(&Record::read(early.path()).unwrap()).standing, Standing::Unknown);
}

#[test]
fn a_comparison_says_at_its_top_who_is_better_and_only_if_that_can_be_said() {
    let good = r#"{"validated":3,"photometric":0.1,"warped":0.1,"unwarped":0.2}"#;
    let healthy = ended(good, METRICS);
    let failed = ended(good, r#"{"steps":3,"after":{"abs_rel":0.5},"mean_map":{"abs_rel":0.393}}"#);
    let mut runs = [failed, healthy].map(|folder| Record::read(folder.path()).unwrap());
    runs[0].name = "constant".into();
    runs[1].name = "healthy".into();
    let page = page::page(&runs, &[]);
    let verdict = page.split("class=\"verdict\">").nth(1).unwrap().split("</p>").next().unwrap();
    let expected = "healthy is healthy. constant has not learnt depth. Abs Rel on test data, best first: healthy 0.131, \
                    constant 0.500.";
    assert_eq!(verdict, expected);
    assert!(page.find("class=\"verdict\"").unwrap() < page.find("<h2>").unwrap(), "nothing stands above it");
    runs[0].config.push(("seed".into(), "5".into()));
    assert!(page::page(&runs, &[]).contains("of different pictures (seed differ) and cannot be compared"));
}

#[test]
fn what_an_old_folder_lacks_is_named_with_the_way_to_get_it() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    fs::write(place.join("config.toml"), "steps = 3\n").unwrap();
    fs::write(place.join("log.jsonl"), "{\"step\":3,\"loss\":0.5}\n{\"validated\":3,\"photometric\":0.1}\n{\"val")
        .unwrap();
    let words = |folder: &std::path::Path| {
        let run = Record::read(folder).unwrap();
        let gaps: Vec<String> = run.gaps.iter().map(|gap| format!("{} | {}", gap.what, gap.how)).collect();
        gaps.join("\n") + &run.problems.join("\n")
    };
    let found = words(place);
    for expected in [
        "of an older version",
        "no warnings.jsonl",
        "there are no views",
        "copy best.safetensors",
        "(pages/)",
        "no machine.json",
        "no metrics.json",
        "last line of log.jsonl is torn",
    ] {
        assert!(found.contains(expected), "{expected}: {found}");
    }
    fs::write(place.join("best.safetensors"), "").unwrap();
    assert!(words(place).contains("`parallax report RUN --views` makes them"));
    // One that is being trained gets them by itself.
    let lock = fs::File::create(place.join(".lock")).unwrap();
    lock.lock().unwrap();
    let found = words(place);
    assert!(found.contains("its next validation leaves them") && !found.contains("metrics.json"), "{found}");
    assert!(page::page(&[Record::read(place).unwrap()], &[]).contains("being trained: step 3 of 3"));
}

#[test]
fn the_time_that_the_page_took_is_a_share_of_the_training() {
    let folder = run("3");
    let log = "{\"step\":3,\"loss\":0.25,\"flow\":1.0}\n{\"page\":2,\"seconds\":0.5,\"trained\":50.0}\n\
               {\"page\":3,\"seconds\":0.25,\"trained\":100.0}\n";
    fs::write(folder.path().join("log.jsonl"), log).unwrap();
    let run = Record::read(folder.path()).unwrap();
    assert_eq!(run.page_time(), Some([0.75, 100.0]));
    assert!(page::page(&[run], &[]).contains("0.8 s, 0.8 % of the 100 s of training"));
}
