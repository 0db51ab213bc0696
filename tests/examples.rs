//! The examples that are programs on their own run as they stand.

#[path = "../examples/digits.rs"]
mod digits;
#[path = "../examples/train_and_predict.rs"]
mod train_and_predict;

#[test]
fn digits_are_learnt() {
    digits::main();
}

#[test]
fn a_program_trains_and_predicts() {
    train_and_predict::main().expect("trained and predicted");
}
