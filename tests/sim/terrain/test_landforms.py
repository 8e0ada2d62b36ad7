"""Tests of landforms: their specified shapes, and independence of each other."""

import os
import subprocess
import sys
from typing import Literal

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from marsyard.sim.terrain import TerrainParameters, synthesise
from marsyard.sim.terrain.landforms import Dunes, Fans, Gullies, Lava, Playa, Ramp, Swell, TerrainGround
from marsyard.sim.terrain.landforms.bedrock import locate_points
from marsyard.sim.terrain.landforms.ground import refine
from marsyard.sim.terrain.landforms.kernels.bedrock import add_cracks
from marsyard.sim.terrain.landforms.kernels.wind import Bedforms, add_dunes
from marsyard.sim.terrain.landforms.random_fields import draw_smooth_fields
from marsyard.sim.terrain.statistics import mean_slope_deg

SMOOTH = TerrainParameters(samples=512, rms_slope_deg=0.0, craters_per_km2=0.0, albedo_contrast=0.0)


def make_parameters(**changes: object) -> TerrainParameters:
    return SMOOTH.model_copy(update=changes)


def synthesise_heights(parameters: TerrainParameters, seed: int = 1) -> np.ndarray:
    return synthesise(parameters, np.random.default_rng(seed)).levels[0][..., 0].astype(np.float64)


LANDFORMS: dict[str, object] = {
    "rms_slope_deg": 2.0,
    "dunes": Dunes(),
    "ripples": Dunes(wavelength_m=20.0, height_m=0.8),
    "lava": Lava(),
    "fans": Fans(radius_m=250.0, apex_spacing_m=150.0, divides=1, polygons=Playa(polygon_m=30.0)),
    "playa": Playa(),
    "swell": Swell(relief_m=30.0),
    "ramp": Ramp(length_m=200.0),
    "gullies": Gullies(width_m=20.0, length_m=200.0, per_km2=20.0),
}


@pytest.mark.parametrize("name", LANDFORMS)
def test_equal_seeds_produce_equal_bytes(name: str) -> None:
    parameters = make_parameters(**{name: LANDFORMS[name]})
    first, same_seed, other_seed = (
        synthesise_heights(parameters),
        synthesise_heights(parameters),
        synthesise_heights(parameters, seed=2),
    )
    assert first.tobytes() == same_seed.tobytes()
    assert np.isfinite(first).all()
    assert np.ptp(first) > 0.0
    assert (name == "ramp") == np.array_equal(first, other_seed)


@pytest.mark.parametrize("name", ["dunes", "lava", "swell", "ramp", "gullies", "playa"])
def test_added_landform_does_not_change_others(name: str) -> None:
    """The contribution of a landform to the heights does not depend on the other landforms."""
    rough_parameters = make_parameters(rms_slope_deg=2.0, ripples=LANDFORMS["ripples"])
    contribution = synthesise_heights(make_parameters(**{name: LANDFORMS[name]}))
    with_landform = rough_parameters.model_copy(update={name: LANDFORMS[name]})
    difference = synthesise_heights(with_landform) - synthesise_heights(rough_parameters)
    np.testing.assert_allclose(difference, contribution, atol=1e-3)


def test_dunes_have_specified_wavelength_height_and_slip_faces() -> None:
    dunes = Dunes(wavelength_m=64.0, height_m=4.0, wind_from_deg=270.0, crest_length=6.0, regularity=4.0)
    surface = synthesise(make_parameters(samples=1024, spacing_m=1.0, dunes=dunes), np.random.default_rng(3))
    heights = surface.levels[0][..., 0].astype(np.float64)
    power = (np.abs(np.fft.rfft(heights, axis=1)) ** 2).mean(axis=0)
    assert np.argmax(power[1:]) + 1 == pytest.approx(1024 / 64, abs=1.5)
    # Downwind is east. The lee slopes face east and are steepest, at the angle of repose.
    x, y = np.meshgrid(np.arange(0, 1024, 0.5), np.arange(0, 1024, 16.0))
    slope = surface.gradient(x, y)[..., 0]
    lee_slope_deg = np.degrees(np.arctan(-np.quantile(slope, 0.01)))
    assert 30.0 <= lee_slope_deg <= 34.0
    assert np.degrees(np.arctan(slope.max())) < 20.0, "the stoss slope is gentle"
    assert np.mean(slope > 0) > 0.7, "the stoss slope is longer than the lee slope"


def test_wind_direction_rotates_the_crests() -> None:
    crests_north = synthesise_heights(make_parameters(dunes=Dunes(wavelength_m=60.0, wind_from_deg=270.0)))
    crests_east = synthesise_heights(make_parameters(dunes=Dunes(wavelength_m=60.0, wind_from_deg=180.0)))

    def compute_mean_change(heights: np.ndarray, axis: int) -> float:
        return float(np.abs(np.roll(heights, -20, axis=axis) - heights).mean())

    assert compute_mean_change(crests_north, 1) > 2 * compute_mean_change(crests_north, 0)
    assert compute_mean_change(crests_east, 0) > 2 * compute_mean_change(crests_east, 1)


def test_lava_is_rough_at_metres_and_smooth_at_larger_scales() -> None:
    surface = synthesise(make_parameters(samples=1024, lava=Lava()), np.random.default_rng(1))
    assert mean_slope_deg(surface, 6.0) > 2.5 * mean_slope_deg(surface, 90.0)
    assert mean_slope_deg(surface, 90.0) < 2.0


@pytest.mark.parametrize("slope_deg", [8.0, 17.5, 25.0])
@pytest.mark.parametrize("uphill", ["east", "north"])
def test_ramp_has_its_slope_in_the_specified_direction(slope_deg: float, uphill: Literal["east", "north"]) -> None:
    ramp = Ramp(slope_deg=slope_deg, length_m=20.0, uphill=uphill)
    surface = synthesise(make_parameters(spacing_m=0.2, ramp=ramp), np.random.default_rng(0))
    period = surface.period_m
    uphill_m = np.linspace(0.25 * period - 8.5, 0.25 * period + 8.5, 50)
    cross_m = np.linspace(0.0, period, 50)
    position = (uphill_m, cross_m) if uphill == "east" else (cross_m, uphill_m)
    gradient = surface.gradient(*position)
    uphill_axis, cross_axis = (0, 1) if uphill == "east" else (1, 0)
    np.testing.assert_allclose(np.degrees(np.arctan(gradient[:, uphill_axis])), slope_deg, atol=0.05)
    np.testing.assert_allclose(gradient[:, cross_axis], 0.0, atol=1e-4)
    base_gradient = surface.gradient(*((0.0, 5.0) if uphill == "east" else (5.0, 0.0)))
    np.testing.assert_allclose(base_gradient, 0.0, atol=1e-4)


def test_swell_has_the_specified_relief() -> None:
    assert np.ptp(synthesise_heights(make_parameters(swell=Swell(relief_m=120.0)))) == pytest.approx(120.0, rel=0.01)


def test_fans_descend_to_an_almost_level_playa() -> None:
    fans = Fans(radius_m=250.0, apex_spacing_m=150.0, divides=1, slope_deg=4.0, washes_per_fan=0)
    surface = synthesise(make_parameters(samples=512, rms_slope_deg=1.0, fans=fans), np.random.default_rng(2))
    x = np.linspace(0.0, surface.period_m, 200)
    fan_slopes_deg = np.degrees(np.arctan(np.abs(surface.gradient(x, np.full_like(x, 110.0))[:, 1])))
    playa_gradients = surface.gradient(x, np.full_like(x, 384.0))
    assert 2.0 < np.median(fan_slopes_deg) < 5.0
    assert np.degrees(np.arctan(np.abs(playa_gradients))).mean() < 0.2
    albedo_fan, albedo_playa = surface.albedo(x, np.full_like(x, 110.0)), surface.albedo(x, np.full_like(x, 384.0))
    assert np.log(albedo_fan.mean() / albedo_playa.mean()) == pytest.approx(fans.fan_contrast, abs=0.02)


def test_gullies_have_steep_walls() -> None:
    gullies = Gullies(width_m=6.0, wall_slope_deg=35.0, per_km2=400.0, length_m=60.0)
    surface = synthesise(make_parameters(spacing_m=0.25, samples=512, gullies=gullies), np.random.default_rng(1))
    x, y = np.meshgrid(np.arange(0, 128, 0.25), np.arange(0, 128, 0.25))
    slope = np.degrees(np.arctan(np.hypot(*np.moveaxis(surface.gradient(x, y), -1, 0))))
    assert 25.0 < np.quantile(slope, 0.995) < 45.0
    heights = surface.levels[0][..., 0]
    assert np.mean(heights > -0.01) > 0.4, "the ground between gullies is unchanged"
    assert heights.min() < -1.0


def test_refined_control_values_define_the_same_surface() -> None:
    rng = np.random.default_rng(0)
    coarse = rng.normal(size=(16, 16)).astype(np.float32)
    fine = refine(coarse, 64)
    x, y = rng.uniform(0, 16, 200), rng.uniform(0, 16, 200)
    expected = map_coordinates(coarse.astype(float), [y, x], order=3, mode="grid-wrap", prefilter=False)
    actual = map_coordinates(fine.astype(float), [4 * y, 4 * x], order=3, mode="grid-wrap", prefilter=False)
    np.testing.assert_allclose(actual, expected, atol=2e-6)


def test_smooth_fields_have_unit_power() -> None:
    powers = [
        np.mean(np.sum(draw_smooth_fields(100.0, 4.0, 8.0, 0.3, np.random.default_rng(seed)) ** 2.0, axis=2))
        for seed in range(30)
    ]
    assert np.mean(powers) == pytest.approx(1.0, abs=0.05)


def test_landforms_on_a_coarser_grid_have_the_same_position() -> None:
    ground = TerrainGround(np.zeros((64, 64), np.float32), np.zeros((64, 64), np.float32), 1.0)
    coarse = ground.coarser(4.0)
    assert (coarse.side, coarse.spacing_m, coarse.period_m) == (16, 4.0, 64.0)
    coarse.height[4, 8] = 1.0
    ground.add(coarse)
    assert tuple(map(int, np.unravel_index(ground.height.argmax(), (64, 64)))) == (16, 32)


@pytest.mark.parametrize(
    ("invalid", "message"),
    [
        ({"dunes": Dunes(wavelength_m=5000.0)}, r"wavelength_m of dunes, ripples or bedforms is 5000"),
        ({"ramp": Ramp(length_m=2000.0)}, r"ramp\.length_m is 2000"),
    ],
)
def test_inconsistent_landforms_are_rejected(invalid: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        synthesise(make_parameters(**invalid), np.random.default_rng(0))


@pytest.mark.parametrize("sharpness", [0.0, 1.0])
def test_dune_kernel_matches_scipy(sharpness: float) -> None:
    """Compare the spline and arctangent of `add_dunes` with SciPy and NumPy; the other formulas are the same."""
    side, spacing, crest, max_slope = 128, 3.0, 4.0, 0.6
    modulation = np.random.default_rng(2).normal(size=(32, 32, 2)).astype(np.float32)
    wave = 2.0 * np.pi / (side * spacing) * np.array([5.0, -3.0])
    height, log_albedo = np.zeros((2, side, side), dtype=np.float32)
    add_dunes(height, log_albedo, spacing, modulation, Bedforms(wave[0], wave[1], crest, max_slope, 0.3, sharpness))
    rows, columns = np.mgrid[:side, :side]
    real, imaginary = (
        map_coordinates(
            component.astype(np.float64), [rows / 4, columns / 4], order=3, mode="grid-wrap", prefilter=False
        )
        for component in np.moveaxis(modulation, -1, 0)
    )
    strength = np.hypot(real, imaginary)
    phase = spacing * (wave[0] * columns + wave[1] * rows) + np.arctan2(imaginary, real)
    crest_phase = np.mod(phase / (2.0 * np.pi), 1.0)
    crest_height = crest * np.minimum(strength, 1.6)
    slip_fraction = np.clip(4.0 / 3.0 * crest_height * np.linalg.norm(wave) / (2.0 * np.pi * max_slope), 0.01, 0.5)
    stoss, slip_face = crest_phase / (1.0 - slip_fraction), (1.0 - crest_phase) / slip_fraction
    shape = np.where(
        crest_phase < 1.0 - slip_fraction,
        stoss**2 * (0.4 + 0.6 * stoss) if sharpness else 0.25 * stoss + 0.75 * stoss**2 * (3.0 - 2.0 * stoss),
        np.where(slip_face > 0.5, 4.0 / 3.0 * slip_face - 1.0 / 3.0, 4.0 / 3.0 * slip_face**2),
    )
    np.testing.assert_allclose(height, crest_height * shape, atol=1e-5)
    grains = shape**3 if sharpness else shape
    np.testing.assert_allclose(log_albedo, 0.3 * (grains - 0.5) * np.minimum(strength, 1.0), atol=1e-5)


def test_cracks_follow_periodic_voronoi_borders() -> None:
    side, spacing, count, width = 96, 0.5, 8, 0.8
    cell = side * spacing / count
    points = np.random.default_rng(4).uniform(0.1, 0.9, (count, count, 2))
    height, log_albedo = np.zeros((2, side, side), dtype=np.float32)
    add_cracks(height, log_albedo, spacing, locate_points(points), cell, width, 0.2, -0.1)
    row, column = np.mgrid[:count, :count]
    positions = (points + np.stack([column, row], axis=-1)).reshape(-1, 2)
    y, x = np.mgrid[:side, :side] * spacing / cell
    distance, nearest = map(
        np.asarray, cKDTree(positions, boxsize=np.full(2, float(count))).query(np.stack([x, y], axis=-1), k=2)
    )
    separation = (positions[nearest[..., 1]] - positions[nearest[..., 0]] + count / 2) % count - count / 2
    border_distance_m = (
        0.5 * (distance[..., 1] ** 2 - distance[..., 0] ** 2) / np.linalg.norm(separation, axis=-1) * cell
    )
    fraction = np.clip(1.0 - border_distance_m / width, 0.0, None)
    # The kernel searches one cell on each side for the two nearest points; few of them are farther away.
    assert np.mean(np.isclose(height, -0.2 * fraction, atol=1e-6)) > 0.999
    assert np.mean(np.isclose(log_albedo, -0.1 * fraction, atol=1e-6)) > 0.999


def test_dunes_finer_than_the_grid_are_sampled_directly() -> None:
    """Both the dunes and their modulation are finer than the grid spacing."""
    ripples = Dunes(wavelength_m=1.0, height_m=0.05, regularity=0.3, crest_length=0.5)
    heights = synthesise_heights(make_parameters(samples=64, spacing_m=3.0, ripples=ripples))
    assert 0.0 < np.ptp(heights) < 0.1


@pytest.mark.slow
def test_bytes_do_not_depend_on_the_number_of_threads() -> None:
    program = (
        "import hashlib, numpy as np\n"
        "from marsyard.sim.terrain import TerrainParameters, synthesise\n"
        "from marsyard.sim.terrain.landforms import *\n"
        "p = TerrainParameters(samples=256, dunes=Dunes(), lava=Lava(), swell=Swell(), playa=Playa())\n"
        "print(hashlib.sha256(synthesise(p, np.random.default_rng(5)).levels[0].tobytes()).hexdigest())\n"
    )
    hashes = set()
    for threads in ("1", "4"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads)}
        command = [sys.executable, "-c", program]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        hashes.add(run.stdout.strip())
    assert len(hashes) == 1
