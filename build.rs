//! Tells the tests whether the real piece of KITTI is at hand: `PARALLAX_KITTI` names the folder that holds
//! `2011_09_26/` and `splits/`. Without it the tests that need it are listed as ignored, never as passed.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=PARALLAX_KITTI");
    println!("cargo:rustc-check-cfg=cfg(kitti)");
    // Bugs planted in kernels, for a build that checks the checks (`.ci/thorough`).
    println!("cargo:rustc-check-cfg=cfg(mutants)");
    if std::env::var_os("PARALLAX_KITTI").is_some_and(|folder| !folder.is_empty()) {
        println!("cargo:rustc-cfg=kitti");
    }
}
