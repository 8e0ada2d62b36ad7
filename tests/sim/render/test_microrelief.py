"""Tests of relief finer than the terrain's samples: spectrum, shading, and unchanged geometric truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_device, to_host, vectors_to_device
from marsyard.sim.render.device import Array3f64, Float, Float64, UInt32
from marsyard.sim.render.micro_relief import (
    HEIGHT_VARIANCE,
    SLOPE_VARIANCE,
    MicroRelief,
    RoughGround,
    octave_heights,
    relief_slopes,
    smith_shadowing,
)
from marsyard.sim.render.noise import noise_in_plane
from marsyard.sim.render.texture import MIN_SLOPE_CELLS, SLOPE_FADING
from marsyard.sim.terrain import Surface
from tests.sim.scenes import LAMBERT, descent_camera

#: Map of amplitude factors with a single sample, 1: equal relief everywhere.
UNIFORM = np.ones((1, 1, 3), dtype=np.float32)
POSE = rigid(Rotation.identity(), np.array([30.0, 40.0, 20.0]))


def _make_relief(coarsest_m: float, *heights_m: float) -> MicroRelief:
    """Create octaves of relief, equal everywhere; `coarsest_m` is the cell size of the first octave."""
    return MicroRelief(coarsest_m, np.array(heights_m), factors=UNIFORM, per_metre=0.0)


def _sample_noise(x: np.ndarray, y: np.ndarray, seed: int = 0) -> np.ndarray:
    """Compute value and x and y derivatives of the noise, shape (n, 3)."""
    position = [to_device(Float64, values) for values in (x, y)]
    noise = noise_in_plane(position, Float64(1.0), UInt32(seed))
    return np.stack([to_host(values).astype(np.float64) for values in noise], axis=1)


def _add_slopes(x: np.ndarray, y: np.ndarray, footprint_m: np.ndarray, relief: MicroRelief) -> list[np.ndarray]:
    """Compute slopes along x and y, and resolved and unresolved variance of slope."""
    ground = RoughGround.of(relief)
    assert ground is not None
    positions = vectors_to_device(Array3f64, np.stack([x, y, np.zeros(x.size)], axis=1))
    slopes = relief_slopes(ground, positions, to_device(Float, footprint_m))
    return [to_host(values) for values in (slopes.x, slopes.y, slopes.resolved, slopes.unresolved)]


@pytest.fixture(scope="module")
def flat() -> Surface:
    return Surface.from_samples(np.broadcast_to(np.array([0.0, 0.2], dtype=np.float32), (64, 64, 2)), 1.0)


def test_noise_has_the_specified_variances_and_derivatives() -> None:
    x, y = np.random.default_rng(3).uniform(-200.0, 200.0, (2, 40000))
    noise = _sample_noise(x, y)
    assert np.mean(noise[:, 0]) == pytest.approx(0.0, abs=0.005)
    assert np.mean(noise[:, 0] ** 2) == pytest.approx(HEIGHT_VARIANCE, rel=0.03)
    assert np.mean(noise[:, 1:] ** 2) == pytest.approx(SLOPE_VARIANCE, rel=0.03)
    # the noise has single precision
    step = 2e-3
    derivative_x = (_sample_noise(x + step, y)[:, 0] - _sample_noise(x - step, y)[:, 0]) / (2.0 * step)
    derivative_y = (_sample_noise(x, y + step)[:, 0] - _sample_noise(x, y - step)[:, 0]) / (2.0 * step)
    np.testing.assert_allclose(noise[:, 1], derivative_x, atol=3e-4)
    np.testing.assert_allclose(noise[:, 2], derivative_y, atol=3e-4)


@pytest.mark.parametrize("hurst", [0.5, 0.75, 0.9])
def test_octaves_continue_the_spectrum_of_the_terrain(hurst: float) -> None:
    """Height differences over short lags agree with the integral of the terrain's spectrum beyond its samples.

    The coarsest octave has a median of 0.61 waves per cell and begins at 1 / sqrt(2) of that frequency.
    """
    slope_rad, baseline_m, outer_m, spacing_m = np.radians(3.0), 1.0, 15.0, 0.2
    coarsest, heights = octave_heights(hurst, slope_rad, baseline_m, outer_m, spacing_m)
    k0 = 2.0 * np.pi / outer_m

    def structure_function(lag: float, min_wavenumber: float = 0.0) -> float:
        """Compute the mean square difference over a lag for unit variance, from waves above `min_wavenumber`, rad/m."""
        k = np.geomspace(max(min_wavenumber, 1e-4 * k0), 2.0 * np.pi / 0.0005, 200_001)
        power = 2.0 * hurst * k0 ** (2.0 * hurst) * k * (k**2 + k0**2) ** -(hurst + 1.0)
        return float(np.trapezoid(2.0 * power * (1.0 - special.j0(k * lag)), k))

    variance = (np.tan(slope_rad) * baseline_m) ** 2 / structure_function(baseline_m)
    min_octave_wavenumber = 2.0 * np.pi * 0.61 / coarsest / np.sqrt(2.0)
    x, y = np.random.default_rng(4).uniform(0.0, 50.0, (2, 20000))
    for lag in (0.01, 0.03):
        height_changes = np.zeros(x.size)
        for octave, height in enumerate(heights):
            cell = coarsest * 0.5**octave
            height_changes += height * (_sample_noise((x + lag) / cell, y / cell, octave)[:, 0])
            height_changes -= height * (_sample_noise(x / cell, y / cell, octave)[:, 0])
        assert np.sqrt(np.mean(height_changes**2)) == pytest.approx(
            np.sqrt(variance * structure_function(lag, min_octave_wavenumber)), rel=0.1
        )


@pytest.mark.parametrize("cell_px", [4.0, 2.0])
def test_slopes_are_attenuated_as_by_averaging_over_a_pixel(cell_px: float) -> None:
    """The RMS of attenuated slopes equals that of slopes averaged over pixels of 15 x 15 samples."""
    pixels, samples_per_pixel = 40, 15
    centre = np.arange(pixels) / cell_px
    offset = (np.arange(samples_per_pixel) - 7.0) / samples_per_pixel / cell_px
    x, y = np.meshgrid((centre[:, None] + offset).ravel(), (centre[:, None] + offset).ravel())
    slope = _sample_noise(x, y)[:, 1].reshape(pixels, samples_per_pixel, pixels, samples_per_pixel)
    expected = slope.mean(axis=(1, 3))
    u, v = (grid.ravel() for grid in np.meshgrid(centre, centre))
    outputs = _add_slopes(u, v, np.full(u.size, 1.0 / cell_px), _make_relief(1.0, 1.0))
    assert np.std(outputs[0]) == pytest.approx(np.std(expected), rel=0.06)
    np.testing.assert_allclose(outputs[2] + outputs[3], SLOPE_VARIANCE, rtol=1e-6)


def test_unresolved_octaves_only_add_to_the_variance() -> None:
    position = np.array([0.3])
    outputs = _add_slopes(position, position, np.array([1.001 / MIN_SLOPE_CELLS]), _make_relief(1.0, 0.1, 0.1))
    assert outputs[0][0] == outputs[1][0] == outputs[2][0] == 0.0
    assert outputs[3][0] == pytest.approx((0.1**2 + 0.2**2) * SLOPE_VARIANCE)
    # Octaves with cells of up to sqrt(SLOPE_FADING) footprints are unresolved.
    assert pytest.approx(MIN_SLOPE_CELLS**2) == SLOPE_FADING


@pytest.mark.parametrize("elevation_deg", [5.0, 15.0, 30.0, 60.0])
@pytest.mark.parametrize("slope_deg", [5.0, 15.0, 25.0])
def test_shadowing_equals_smiths_formula(elevation_deg: float, slope_deg: float) -> None:
    """Smith's parameter a is the tangent of the elevation divided by sqrt(2) times the RMS slope sigma."""
    # On level ground the cosine of the angle of incidence is the sine of the elevation.
    cosine, sigma = np.sin(np.radians(elevation_deg)), np.tan(np.radians(slope_deg))
    a = cosine / (np.sqrt(2.0) * sigma * np.sqrt(1.0 - cosine**2))
    smith_lambda = 0.5 * (np.exp(-(a**2)) / (a * np.sqrt(np.pi)) - special.erfc(a))
    result = to_host(smith_shadowing(Float(cosine), Float(sigma**2)))[0]
    assert result == pytest.approx(1.0 / (1.0 + smith_lambda), abs=0.005)


def _shade_heights(heights: np.ndarray, step_m: float, sun: np.ndarray) -> np.ndarray:
    """Compute Lambert shading of a fine height field; find cast shadows by marching along the sun's azimuth."""
    slope_y, slope_x = np.gradient(heights, step_m)
    cosine = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    horizontal = np.hypot(*sun[:2])
    rise, is_shaded = sun[2] / horizontal * step_m, np.zeros(heights.shape, dtype=bool)
    rows, columns = np.mgrid[: heights.shape[0], : heights.shape[1]].astype(float)
    for step in range(1, int(np.ptp(heights) / rise) + 2):
        positions = [rows + step * sun[1] / horizontal, columns + step * sun[0] / horizontal]
        is_shaded |= map_coordinates(heights, positions, order=1, mode="nearest") > heights + step * rise
    return np.where(is_shaded, 0.0, np.maximum(cosine, 0.0))


@pytest.mark.parametrize("rms_slope_deg", [pytest.param(8.0, marks=pytest.mark.slow), 15.0])
def test_shading_changes_with_the_sun_as_for_a_height_field(
    renderer: Renderer, flat: Surface, rms_slope_deg: float
) -> None:
    """Images under two sun azimuths 90 deg apart have the correlation of a ray-cast height field, within 0.05."""
    cell, pixels, samples_per_pixel = 0.8, 96, 6
    relief = _make_relief(cell, np.tan(np.radians(rms_slope_deg)) * cell / np.sqrt(SLOPE_VARIANCE))
    rays = PixelRays.from_camera(descent_camera(pixels, (0.0, 0.0, 0.0)))
    suns = [direction(np.radians(azimuth), np.radians(35.0)) for azimuth in (60.0, 150.0)]
    scene = Scene(flat, (30.0, 40.0), Sun(suns[0]), LAMBERT, relief=relief)
    frames = [renderer.render(replace(scene, sun=Sun(sun)), rays, POSE) for sun in suns]
    rendered_correlation = np.corrcoef(frames[0].radiance.ravel(), frames[1].radiance.ravel())[0, 1]
    points = frames[0].points_world()
    x0, x1 = np.sort(points[0, [0, -1], 0])
    y0, y1 = np.sort(points[[0, -1], 0, 1])
    step = (x1 - x0) / (pixels - 1) / samples_per_pixel
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    heights = relief.heights[0] * _sample_noise(x / cell, y / cell)[:, 0].reshape(x.shape)
    reference_images = []
    for sun in suns:
        image = _shade_heights(heights, step, sun)
        rows, columns = (extent // samples_per_pixel for extent in image.shape)
        image = image[: rows * samples_per_pixel, : columns * samples_per_pixel]
        image = image.reshape(rows, samples_per_pixel, columns, samples_per_pixel)
        reference_images.append(image.mean(axis=(1, 3)).ravel())
    assert rendered_correlation == pytest.approx(np.corrcoef(*reference_images)[0, 1], abs=0.05)
    for frame in frames:
        assert frame.radiance.std() > 0.03 * frame.radiance.mean()


def test_relief_does_not_change_geometric_truth_and_mean_brightness(renderer: Renderer, flat: Surface) -> None:
    rays = PixelRays.from_camera(descent_camera(128))
    without_relief = Scene(flat, (30.0, 40.0), Sun(direction(2.0, np.radians(50.0))), LAMBERT)
    with_relief = replace(without_relief, relief=_make_relief(1.2, *0.02 * 0.5 ** np.arange(8.0)))
    first, second = (renderer.render(scene, rays, POSE) for scene in (without_relief, with_relief))
    np.testing.assert_array_equal(first.range_m, second.range_m)
    np.testing.assert_array_equal(first.normal, second.normal)
    assert second.radiance.std() > 2.0 * first.radiance.std()
    assert second.radiance.mean() == pytest.approx(first.radiance.mean(), rel=0.01)
