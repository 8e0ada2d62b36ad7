import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim.sensor import Altimeter, AltimeterParameters, Navigation, NavigationParameters
from sim.terrain import Surface

TRUE = Rotation.from_euler("xyz", [10.0, -20.0, 30.0], degrees=True)


def _flat(height_m: float) -> Surface:
    samples = np.full((64, 64, 2), height_m, dtype=np.float32)
    return Surface.from_samples(samples, 5.0)


def test_without_errors_truth_is_delivered() -> None:
    perfect = NavigationParameters(
        attitude_bias_deg=0.0,
        attitude_noise_deg=0.0,
        velocity_bias_m_s=0.0,
        velocity_noise_m_s=0.0,
        image_time_jitter_s=0.0,
    )
    navigation = Navigation.drawn(perfect, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    assert navigation.tag(2.5, rng) == 2.5
    measured = navigation.attitude(TRUE, 2.5, rng)
    assert (measured.world_from_body * TRUE.inv()).magnitude() < 1e-15
    np.testing.assert_array_equal(navigation.velocity(np.array([1.0, 2.0, 3.0]), rng), [1.0, 2.0, 3.0])
    altimeter = Altimeter.drawn(AltimeterParameters(scale_error=0.0, noise=0.0), _flat(12.0), rng)
    assert altimeter.measure(np.array([40.0, -900.0, 1012.0]), rng) == pytest.approx(1000.0)


def test_errors_have_the_stated_spread_and_the_bias_is_common() -> None:
    parameters = NavigationParameters(attitude_bias_deg=1.0, attitude_noise_deg=0.1, velocity_bias_m_s=5.0)
    biases, noises, velocity = [], [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        navigation = Navigation.drawn(parameters, rng)
        errors = [
            (navigation.attitude(TRUE, 0.0, rng).world_from_body * TRUE.inv()).as_rotvec(degrees=True) for _ in range(2)
        ]
        biases.append(np.mean(errors, axis=0))
        noises.append((errors[0] - errors[1]) / np.sqrt(2.0))
        velocity.append(navigation.velocity(np.zeros(3), rng))
    # 1,200 values each: the spread is known to 2 %; tolerance three times that
    assert np.std(biases) == pytest.approx(np.hypot(1.0, 0.1 / np.sqrt(2.0)), rel=0.06)
    assert np.std(noises) == pytest.approx(0.1, rel=0.06)
    assert np.std(velocity) == pytest.approx(5.0, rel=0.06)


def test_altimeter_scale_is_common_and_noise_is_not() -> None:
    surface, position = _flat(0.0), np.array([0.0, 0.0, 1000.0])
    parameters = AltimeterParameters(scale_error=0.01, noise=0.001)
    common, noise = [], []
    for seed in range(600):
        rng = np.random.default_rng(seed)
        altimeter = Altimeter.drawn(parameters, surface, rng)
        first, second = altimeter.measure(position, rng), altimeter.measure(position, rng)
        common.append(0.5 * (first + second) - 1000.0)
        noise.append((first - second) / np.sqrt(2.0))
    assert np.std(common) == pytest.approx(10.0, rel=0.1)
    assert np.std(noise) == pytest.approx(1.0, rel=0.1)


def test_altimeter_measures_the_mean_of_its_patch() -> None:
    samples = np.zeros((256, 256, 2), dtype=np.float32)
    samples[..., 0] = 10.0 * np.sin(2 * np.pi * np.arange(256) / 8)[None, :]
    surface = Surface.from_samples(samples, 5.0)
    altimeter = Altimeter(AltimeterParameters(beam_m=300.0), surface, 1.0)
    # waves of 40 m vanish in a patch of 300 m, wherever it lies
    heights = [altimeter.true_altitude(np.array([x, 0.0, 1000.0])) for x in np.linspace(0.0, 40.0, 9)]
    np.testing.assert_allclose(heights, 1000.0, atol=0.2)
