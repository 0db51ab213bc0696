//! Where the time goes: profiles of several iterations, gathered in rows that add up.

use std::collections::BTreeMap;

use parallax::tensor::profile::Profile;
use serde::Serialize;

/// One op on one kernel path, or something that is no op (without a kernel path); of one iteration.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    pub op: String,
    pub algo: String,
    pub calls: usize,
    /// Arithmetic of the forward pass.
    pub gflop: f64,
    /// Least memory traffic of the forward pass: inputs and outputs, each once.
    pub bytes: u64,
    /// Arithmetic of the backward pass to those gradients that are wanted.
    pub backward_gflop: f64,
    /// Least memory traffic of the backward pass: inputs, the outputs' gradients and the inputs', each once.
    pub backward_bytes: u64,
    pub forward_ms: f64,
    pub backward_ms: f64,
}

impl Row {
    /// Of both passes.
    pub fn milliseconds(&self) -> f64 {
        self.forward_ms + self.backward_ms
    }
}

/// Means over the middle half of the profiles by their totals, the slowest row first, then `other`: what no row
/// accounts for, so that all rows add up to the mean total.
pub fn rows(profiles: &[Profile]) -> Vec<Row> {
    let mut sorted: Vec<&Profile> = profiles.iter().collect();
    sorted.sort_by_key(|p| p.total);
    let cut = sorted.len() / 4;
    let middle = &sorted[cut..sorted.len() - cut];
    if middle.is_empty() {
        return Vec::new();
    }
    let mut rows: BTreeMap<(&str, &str), Row> = BTreeMap::new();
    let mut other = Row { op: "other".into(), calls: middle.len(), ..Row::default() };
    for profile in middle {
        for e in &profile.ops {
            let row = rows.entry((e.op, e.algo)).or_default();
            row.calls += 1;
            row.gflop += e.flops as f64 * 1e-9;
            row.bytes += e.bytes;
            if !e.backward.is_zero() {
                row.backward_gflop += e.back.flops as f64 * 1e-9;
                row.backward_bytes += e.back.bytes;
            }
            row.forward_ms += e.forward.as_secs_f64() * 1e3;
            row.backward_ms += e.backward.as_secs_f64() * 1e3;
        }
        for phase in &profile.phases {
            let row = rows.entry((phase.name, "")).or_default();
            row.calls += 1;
            row.forward_ms += phase.time.as_secs_f64() * 1e3;
        }
        other.forward_ms += profile.total.saturating_sub(profile.accounted()).as_secs_f64() * 1e3;
    }
    let named = |((op, algo), row): ((&str, &str), Row)| Row { op: op.into(), algo: algo.into(), ..row };
    let mut rows: Vec<Row> = rows.into_iter().map(named).collect();
    rows.sort_by(|a, b| b.milliseconds().total_cmp(&a.milliseconds()));
    rows.push(other);
    rows.iter_mut().for_each(|row| divide(row, middle.len()));
    rows
}

/// The row of one iteration from that of `n`.
fn divide(row: &mut Row, n: usize) {
    row.calls /= n;
    row.bytes /= n as u64;
    row.backward_bytes /= n as u64;
    for x in [&mut row.gflop, &mut row.backward_gflop, &mut row.forward_ms, &mut row.backward_ms] {
        *x /= n as f64;
    }
}

#[cfg(test)]
mod tests {
    use parallax::tensor::Precision;
    use std::time::Duration;

    use crate::cli::architecture::ArchitectureArgs;
    use parallax::monovit::Preset;
    use parallax::tensor::profile;

    use super::*;
    use crate::cli::bench::job::{Job, Network, measure};
    use crate::cli::sizes::Sizes;

    const NETWORKS: ArchitectureArgs = ArchitectureArgs { preset: Some(Preset::Pico), network: None, encoder: None };
    const PICO: Sizes = Sizes { networks: NETWORKS, height: 64, width: 96, batch: 1, recompute: false, json: false };

    #[test]
    fn the_rows_of_a_training_step_add_up_to_the_traced_total() {
        let mut network = Network::new(&PICO, 0, None).expect("sizes that fit");
        let profiles = [(); 2].map(|()| {
            let (done, profile) = profile::profile(|| network.once());
            done.expect("a step");
            profile
        });
        for profile in &profiles {
            // Nothing is counted twice: else the parts would exceed the whole, and `other` be cut off at nothing.
            assert!(profile.accounted() <= profile.total, "{:?} of {:?}", profile.accounted(), profile.total);
            let rows = rows(std::slice::from_ref(profile));
            let sum: f64 = rows.iter().map(Row::milliseconds).sum();
            let total = profile.total.as_secs_f64() * 1e3;
            assert!((sum - total).abs() < 1e-9 * total, "{sum} ms in rows, {total} ms in all");
            let calls: usize = rows.iter().filter(|r| !r.algo.is_empty()).map(|r| r.calls).sum();
            assert_eq!(calls, profile.ops.len(), "every op is in a row");
        }
        let rows = rows(&profiles);
        let find = |op: &str| rows.iter().find(|r| r.op == op).unwrap_or_else(|| panic!("no row {op}"));
        for phase in ["adamw", "weight averaging", "tape", "gradient accumulation", "running statistics", "freeing"] {
            assert!(find(phase).milliseconds() > 0.0, "{phase}");
        }
        let conv = find("conv2d");
        assert!(conv.gflop > 0.0 && conv.bytes > 0 && conv.backward_gflop > conv.gflop && conv.backward_ms > 0.0);
        assert_eq!(find("reshape").bytes, 0, "nothing moves");
        assert_eq!(rows.last().map(|r| r.op.as_str()), Some("other"));
    }

    #[test]
    fn an_inference_has_no_backward_pass() {
        let mut network = Network::new(&PICO, 0, Some(Precision::F32)).expect("sizes that fit");
        let profiles = measure(&mut network, 1, true).expect("an inference").profiles;
        let rows = rows(&profiles);
        assert!(rows.len() > 10);
        assert!(rows.iter().all(|r| r.backward_ms == 0.0 && r.backward_gflop == 0.0 && r.backward_bytes == 0));
    }

    #[test]
    fn an_iteration_that_was_disturbed_does_not_move_the_rows() {
        let of = |ms| Profile { total: Duration::from_millis(ms), ..Profile::default() };
        let rows = rows(&[of(10), of(11), of(900), of(12)]);
        assert!((rows[0].forward_ms - 11.5).abs() < 1e-9, "{rows:?}");
        assert!(super::rows(&[]).is_empty());
    }

    #[test]
    fn a_job_runs_as_often_as_it_was_told() {
        struct Count(usize);
        impl Job for Count {
            fn once(&mut self) -> parallax::Result<()> {
                self.0 += 1;
                Ok(())
            }
        }
        let mut job = Count(0);
        let measured = measure(&mut job, 4, true).expect("counting");
        assert_eq!((job.0, measured.seconds.len(), measured.profiles.len()), (3 + 8, 4, 4));
        assert!(measure(&mut job, 4, false).expect("counting").profiles.is_empty());
    }
}
