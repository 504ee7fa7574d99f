use std::sync::Arc;

use super::*;

const SUM_DIFFERENCE: &[u8] = include_bytes!("../../../../tests/onnx/sum_difference.onnx");
const HALF: &[u8] = include_bytes!("../../../../tests/onnx/half.onnx");
const INTEGERS: &[u8] = include_bytes!("../../../../tests/onnx/integers.onnx");

/// Whether ONNX Runtime is available.
fn onnx() -> Option<()> {
    tmpi_testing::Need::Onnx.or_skip(available())
}

fn rows(n: usize, f: impl Fn(usize) -> f32) -> Tensor {
    Tensor { shape: vec![n, 3], data: (0..n * 3).map(f).collect() }
}

fn load() -> Option<Session> {
    onnx().map(|()| Session::load("sum", SUM_DIFFERENCE, &[], &Config::default()).unwrap())
}

#[test]
fn runs_with_inputs_and_outputs_in_the_graphs_order() {
    let Some(session) = load() else { return };
    assert_eq!(session.inputs().iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    assert_eq!(session.outputs()[1], TensorInfo { name: "difference".into(), shape: vec![-1, 3] });
    let out = session.run(vec![rows(2, |i| i as f32), rows(2, |_| 10.0)]).unwrap();
    assert_eq!(out[0], rows(2, |i| i as f32 + 10.0));
    assert_eq!(out[1], rows(2, |i| i as f32 - 10.0));
}

#[test]
fn nan_and_infinity_pass_through_unharmed() {
    let Some(session) = load() else { return };
    let out = session.run(vec![rows(1, |i| [f32::NAN, f32::INFINITY, 1.0][i]), rows(1, |_| 1.0)]).unwrap();
    assert!(out[0].data[0].is_nan() && out[0].data[1].is_infinite() && (out[0].data[2] - 2.0).abs() < f32::EPSILON);
}

#[test]
fn half_precision_networks_take_and_return_32_bits() {
    let Some(()) = onnx() else { return };
    let session = Session::load("half", HALF, &[], &Config::default()).unwrap();
    assert_eq!(session.inputs(), [TensorInfo { name: "a".into(), shape: vec![-1, 3] }]);
    // a tenth is rounded to 11 bits, 1e6 is beyond 16-bit floats
    let out = session.run(vec![rows(1, |i| [0.1, 1e6, -2.0][i])]).unwrap();
    assert!((out[0].data[0] - 0.2).abs() < 1e-4 && (out[0].data[0] - 0.2).abs() > 1e-6, "{:?}", out[0]);
    assert!(out[0].data[1].is_infinite() && (out[0].data[2] + 4.0).abs() < f32::EPSILON);
}

#[test]
fn errors_name_wrong_inputs() {
    let Some(session) = load() else { return };
    let good = || rows(2, |_| 0.0);
    let bad = [
        (vec![good()], "1 inputs given, 2 expected"),
        (vec![good(), good(), good()], "3 inputs"),
        (vec![good(), Tensor { shape: vec![2, 4], data: vec![0.0; 8] }], "input b is [2, 4]"),
        (vec![Tensor { shape: vec![6], data: vec![0.0; 6] }, good()], "input a is [6]"),
        (vec![Tensor { shape: vec![2, 3], data: vec![0.0; 5] }, good()], "has 5 values"),
        (vec![Tensor { shape: vec![0, 3], data: vec![] }, good()], "input a is [0, 3]"),
        (vec![Tensor { shape: vec![usize::MAX, 3], data: vec![] }, good()], "has 0 values"),
        // each input fits by itself, but the graph refuses the pair
        (vec![good(), rows(5, |_| 0.0)], ""),
    ];
    for (inputs, text) in bad {
        let error = session.run(inputs).unwrap_err();
        assert!(matches!(&error, OnnxError::Run { name, reason } if name == "sum" && reason.contains(text)), "{error}");
    }
    assert!(session.run(vec![good(), good()]).is_ok(), "the worker survives errors");
}

#[test]
fn unusable_models_are_errors() {
    let Some(()) = onnx() else { return };
    for (bytes, text) in [(b"".as_slice(), ""), (b"no model", ""), (&SUM_DIFFERENCE[..60], ""), (INTEGERS, "16-bit floats")] {
        let error = Session::load("bad", bytes, &[], &Config::default()).err().unwrap();
        assert!(matches!(&error, OnnxError::Model { reason, .. } if reason.contains(text)), "{error}");
    }
}

#[test]
fn a_missing_provider_is_skipped_only_if_the_processor_is_listed() {
    let Some(()) = onnx() else { return };
    let with = |providers: Vec<Provider>| Session::load("sum", SUM_DIFFERENCE, &[], &Config { providers, threads: 1 });
    assert!(with(vec![Provider::DirectMl, Provider::Cpu]).is_ok());
    assert!(matches!(with(vec![Provider::DirectMl]), Err(OnnxError::Model { .. })));
}

#[test]
fn many_callers_share_one_worker() {
    let Some(session) = load() else { return };
    let session: Arc<dyn Network> = Arc::new(session);
    std::thread::scope(|scope| {
        for t in 0..8 {
            let session = Arc::clone(&session);
            scope.spawn(move || {
                for k in 1..50 {
                    let out = session.run(vec![rows(k, |_| t as f32), rows(k, |i| i as f32)]).unwrap();
                    assert_eq!(out[0], rows(k, |i| t as f32 + i as f32));
                }
            });
        }
    });
}
