//! Evaluations image by image as a table of comma-separated values (RFC 4180).

use std::path::Path;

use super::study::Study;
use crate::Result;
use crate::formats::atomic::write_bytes_atomically;

/// Writes a line for each image of each study, which has a name (of weights, say): `of, image, sequence, pixels, ratio,
/// abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3`. Numbers read back exactly.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, studies: &[(&str, &Study)]) -> Result<()> {
    let mut text = "of,image,sequence,pixels,ratio,abs_rel,sq_rel,rmse,rmse_log,a1,a2,a3\r\n".to_owned();
    for (name, study) in studies {
        for (image, sequence) in study.report.per_image.iter().zip(&study.sequences) {
            let ratio = image.ratio.map_or_else(String::new, |ratio| ratio.to_string());
            let metrics = image.metrics.to_array().map(|m| m.to_string()).join(",");
            let fields = [quoted(name), quoted(&image.name), sequence.to_string(), image.pixels.to_string(), ratio];
            text += &format!("{},{metrics}\r\n", fields.join(","));
        }
    }
    write_bytes_atomically(path, text.as_bytes())
}

/// A field, in quotes if it has to be.
fn quoted(field: &str) -> String {
    if field.contains(['"', ',', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::metrics::{ImageMetrics, Metrics, Report};

    #[test]
    fn every_image_has_its_line_and_commas_their_quotes() {
        let metrics = Metrics { abs_rel: 0.1 + 0.2, a3: 1.0, ..Metrics::default() };
        let image = ImageMetrics { pixels: 7, ratio: Some(2.5), metrics: Some(metrics) };
        let report = Report::new([("street \"a\", frame 1".to_owned(), image)]).unwrap();
        let study = Study {
            report,
            sequences: vec![3],
            interval: None,
            distances: Vec::new(),
            regions: Vec::new(),
            sets: Vec::new(),
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("images.csv");
        write(&path, &[("runs/1", &study)]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let line = "runs/1,\"street \"\"a\"\", frame 1\",3,7,2.5,0.30000000000000004,0,0,0,0,0,1\r\n";
        assert_eq!(text.split_once("\r\n").unwrap().1, line);
    }
}
