"""Tests of the simulation of light in dusty air: energy is conserved, and thin air scatters once."""

import numpy as np
import pytest

from benchmarks.validation.air_checks import draw_upward, simulate_radiance
from marsyard.sim.frames import direction
from marsyard.sim.render import Sun
from marsyard.sim.terrain import Environment

COUNT = 40000
OVERHEAD_SUN = Sun(np.array([0.0, 0.0, 1.0]))


def test_air_without_absorption_reflects_or_transmits_all_sunlight() -> None:
    """Irradiances of the black ground, and of the top of the atmosphere by reflected light, have the sum 1."""
    air = Environment(optical_depth=1.0, single_scattering_albedo=0.999999, asymmetry=0.5)
    rng = np.random.default_rng(1)
    upward = draw_upward(COUNT, rng)
    transmitted = np.exp(-1.0) + simulate_radiance(air, OVERHEAD_SUN, 0.0, 1.0, upward, rng).mean()
    reflected = simulate_radiance(air, OVERHEAD_SUN, 0.0, 0.0, -upward, rng).mean()
    assert transmitted + reflected == pytest.approx(1.0, abs=0.01)
    assert transmitted > 0.7  # forward scattering


def test_white_ground_below_clear_air_reflects_all_light() -> None:
    """Without air the radiance factor of Lambert ground is its albedo times the sine of the sun's elevation."""
    air = Environment(optical_depth=0.0)
    sun = Sun(direction(0.3, np.radians(40.0)))
    looking = np.tile([[0.3, 0.0, -np.sqrt(0.91)]], (100, 1))
    radiance = simulate_radiance(air, sun, 0.8, 0.0, looking, np.random.default_rng(2))
    assert radiance == pytest.approx(0.8 * np.sin(np.radians(40.0)))


@pytest.mark.parametrize("elevation_deg", [25.0, 70.0])
def test_thin_air_has_the_radiance_of_single_scattering(elevation_deg: float) -> None:
    """The sky above black ground agrees with the exact radiance of single scattering (Chandrasekhar 1960)."""
    depth, scattering, g = 0.02, 0.9, 0.6
    air = Environment(optical_depth=depth, single_scattering_albedo=scattering, asymmetry=g)
    sun, view = Sun(direction(1.0, np.radians(elevation_deg))), direction(2.5, np.radians(50.0))
    looking = np.tile(view, (40 * COUNT, 1))
    radiance = simulate_radiance(air, sun, 0.0, depth, looking, np.random.default_rng(3)).mean()
    mu, mu0 = float(view[2]), float(sun.direction[2])
    phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * float(view @ sun.direction)) ** 1.5
    single = scattering / 4.0 * phase * mu0 / (mu0 - mu) * (np.exp(-depth / mu0) - np.exp(-depth / mu))
    # a second scattering adds about the optical depth
    assert radiance == pytest.approx(single, rel=0.05)
