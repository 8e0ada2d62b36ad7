"""Tests of the example with a neural network; `test_tutorials` trains it on rendered images and runs its campaigns."""

import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from marsyard.scenarios.conformance import inputs

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "velocity_network"


@pytest.fixture
def matches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Import the matches of a copy of the example; they need no ONNX Runtime."""
    shutil.copytree(EXAMPLE, tmp_path / EXAMPLE.name, ignore=shutil.ignore_patterns("*.onnx", "__pycache__"))
    monkeypatch.syspath_prepend(str(tmp_path))
    from velocity_network import matches

    yield matches
    for name in [name for name in sys.modules if name.partition(".")[0] == EXAMPLE.name]:
        del sys.modules[name]


@pytest.fixture
def estimator(matches: ModuleType, tmp_path: Path) -> ModuleType:
    """Import the estimator with a network that accepts matches whose correlation is above 0.8."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from sklearn.neural_network import MLPClassifier
    from sklearn.preprocessing import StandardScaler
    from velocity_network import train

    network = MLPClassifier((1,))
    weights = np.zeros((matches.SURFACE_SIZE**2 + 2, 1))
    weights[-2] = 1.0  # the maximum of the correlation
    network.coefs_, network.intercepts_ = [weights, np.array([[100.0]])], [np.array([-0.8]), np.array([-1.0])]
    scaler = StandardScaler().fit(np.array([[-1.0], [1.0]]) * np.ones(len(weights)))  # mean 0, standard deviation 1
    (tmp_path / EXAMPLE.name / "network.onnx").write_bytes(train.to_onnx(scaler, network).SerializeToString())
    from velocity_network import estimator

    return estimator


def test_matches_of_level_ground_have_the_true_velocity(matches: ModuleType) -> None:
    found = matches.find_matches(inputs.descent())
    errors_m_s = np.linalg.norm(found.velocities_m_s - inputs.DESCENT_VELOCITY_M_S[:2], axis=1)
    # templates that the later image does not show have wrong matches; the inertial velocity is wrong by 9.8 m/s
    is_right = errors_m_s < 1.0
    assert is_right.sum() > 50
    # a tenth of a cell of 0.003 x 1337 m in 3.75 s is 0.11 m/s
    assert np.median(errors_m_s[is_right]) < 0.11
    assert matches.network_inputs(found).shape == (len(errors_m_s), matches.SURFACE_SIZE**2 + 2)
    # the first feature is the maximum, at the centre of the surface
    centre = matches.HALF_SURFACE
    np.testing.assert_array_equal(found.surfaces[:, centre, centre], found.features[:, 0])


@pytest.mark.parametrize("blank", inputs.BLANKS)
def test_blank_images_have_no_matches(matches: ModuleType, blank: str) -> None:
    found = matches.find_matches(inputs.make_blank(inputs.descent(), inputs.BLANKS[blank]))
    assert matches.network_inputs(found).shape == (0, matches.SURFACE_SIZE**2 + 2)


def test_missing_altitude_gives_no_matches(matches: ModuleType) -> None:
    measurements = inputs.descent()
    missing = replace(measurements.altitudes[-1], altitude_m=float("nan"))
    altitudes = (*measurements.altitudes[:-1], missing)
    assert len(matches.find_matches(replace(measurements, altitudes=altitudes)).velocities_m_s) == 0


@pytest.mark.slow
def test_batches_give_the_answers_of_single_cases(estimator: ModuleType) -> None:
    network = estimator.NetworkEstimator()
    cases: list[Any] = [inputs.descent(), inputs.make_noisy(inputs.descent()), inputs.inertial_descent(3)]
    answers = network.estimate_batch(cases)
    assert [answer.outcome.name for answer in answers] == ["VALID", "NO_VALID_TRACK", "VALID"]
    for case, answer in zip(cases, answers, strict=True):
        single = network.estimate(case)
        assert single.outcome is answer.outcome
        if answer.velocity_m_s is not None:
            np.testing.assert_array_equal(single.velocity_m_s, answer.velocity_m_s)


@pytest.mark.slow
@pytest.mark.parametrize("device", ["gpu", "cuda", "cuda:x"])
def test_unknown_devices_are_refused(estimator: ModuleType, device: str) -> None:
    with pytest.raises(RuntimeError, match=f"the device is {device}; allowed: cpu, cuda:0"):
        estimator.NetworkEstimator(device=device)


@pytest.mark.slow
def test_missing_gpu_is_reported(estimator: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = estimator.onnxruntime
    if "CUDAExecutionProvider" not in runtime.get_available_providers():
        with pytest.raises(RuntimeError, match="install onnxruntime-gpu instead of onnxruntime"):
            estimator.NetworkEstimator(device="cuda:0")
    # the package of GPUs lists the provider also without a GPU, and then continues on the CPU with a warning
    monkeypatch.setattr(runtime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    with pytest.warns(UserWarning, match="CUDAExecutionProvider"), pytest.raises(RuntimeError, match="cannot use it"):
        estimator.NetworkEstimator(device="cuda:99")


@pytest.mark.slow
def test_training_learns_to_select(matches: ModuleType) -> None:
    """A network trained on separable inputs reproduces their classes in ONNX Runtime."""
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from velocity_network import train

    rng = np.random.default_rng(5)
    values = rng.normal(3.0, 2.0, (400, matches.SURFACE_SIZE**2 + 2)).astype(np.float32)
    is_right = values[:, -2] > 3.0
    scaler, network = train.train(values[:300], is_right[:300])
    session = runtime.InferenceSession(
        train.to_onnx(scaler, network).SerializeToString(), providers=["CPUExecutionProvider"]
    )
    probabilities = session.run(None, {"matches": values[300:]})[0][:, 0]
    expected = network.predict_proba(scaler.transform(values[300:]))[:, 1]
    np.testing.assert_allclose(probabilities, expected, atol=1e-5)  # float32 sums of 291 products
