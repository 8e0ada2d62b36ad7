"""Tests of the surface of rocks: frame of the grain, dust, and their effect on images."""

import numpy as np
import pytest

from marsyard.sim.frames import direction
from marsyard.sim.render import Renderer, Scene, Sun, Texture
from marsyard.sim.render.arrays import to_host
from marsyard.sim.render.device import Array3f, Array3f64, Array4f, Float
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.render.rock_surface import MAX_BED_RATIO, RockSurface, describe_grain, rock_surface, texture_frame
from marsyard.sim.render.rover import ROVER_NAME
from tests.sim.scenes import LAMBERT, NEAR_MESH, flat_ground, level_plate, look_down


def _surface(grain: tuple[float, ...], points_m: np.ndarray, footprint_m: float) -> RockSurface:
    position, normal = Array3f64(*points_m.T), Array3f(0.0, 0.0, 1.0)
    return rock_surface(Array4f(*grain), position, normal, Float(footprint_m))


def _line(length_m: float, count: int = 4000) -> np.ndarray:
    """Points along a line that no lattice direction is parallel to."""
    return np.linspace(0.0, length_m, count)[:, None] * np.array([0.48, 0.64, 0.6]) + (3.1, 1.7, 0.4)


def test_grain_depends_on_the_name_of_a_rock_only() -> None:
    names, sizes = np.arange(1000), np.full(1000, 0.3)
    grain = describe_grain(names, sizes)
    assert np.array_equal(grain[[7, 400]], describe_grain(names[[7, 400]], sizes[:2]))
    ratio = 1.0 + np.sum(grain[:, :3] ** 2, axis=1)
    # half of the rocks are bedded, with ratios uniform from 1 to the maximum
    assert np.mean(ratio > 1.0) == pytest.approx(0.5, abs=0.02)
    assert ratio.max() == pytest.approx(MAX_BED_RATIO, rel=0.01)
    assert len(np.unique(np.round(grain[:, :3], 6), axis=0)) > 490


def test_grain_scales_with_the_rock_and_fades_with_the_footprint() -> None:
    small = to_host(_surface((0.0, 0.0, 0.0, 0.2), _line(2.0), 1e-4).slope)
    large = to_host(_surface((0.0, 0.0, 0.0, 2.0), 10.0 * _line(2.0), 1e-3).slope)
    # noise of equal offsets from the lattice, in single precision
    assert np.max(np.abs(small - large)) < 1e-3
    assert 0.05 < small.std(axis=0).mean() < 0.4
    # the coarsest cells, 4 cm, are smaller than pixels of 10 cm
    assert not to_host(_surface((0.0, 0.0, 0.0, 0.2), _line(2.0), 0.1).slope).any()


def test_bedded_grain_is_longer_along_the_beds() -> None:
    bedding = (0.0, 0.0, float(np.sqrt(3.0)), 0.5)
    slope = to_host(_surface(bedding, _line(4.0), 1e-3).slope)
    # relief is 4 times shorter along z, across the beds
    assert slope[:, 2].std() / slope[:, 0].std() == pytest.approx(4.0, rel=0.2)
    position, _ = texture_frame(Array4f(*bedding), Array3f64(0.0, 0.0, 1.0), Float(0.01))
    across, _ = texture_frame(Array4f(*bedding), Array3f64(1.0, 0.0, 0.0), Float(0.01))
    assert to_host(position.z)[0] == pytest.approx(4.0 * to_host(across.x)[0], rel=1e-6)


def test_dust_has_a_patchy_margin_and_fractures_are_dark_and_rare() -> None:
    surface = _surface((0.0, 0.0, 0.0, 0.3), _line(3.0), 1e-4)
    fractures = to_host(surface.log_albedo)
    assert fractures.min() < -0.35
    assert np.mean(fractures < -0.1) < 0.15
    steep = rock_surface(Array4f(0.0, 0.0, 0.0, 0.3), Array3f64(*_line(3.0).T), Array3f(0.8, 0.0, 0.6), Float(1e-4))
    assert np.ptp(to_host(steep.dust)) > 0.2


@pytest.mark.parametrize(
    ("name", "amplitudes", "contrast"),
    [
        (5, (), (0.0, 1e-3)),
        (5, (0.12,) * 7, (0.1, 1.0)),
        (ROVER_NAME, (0.12,) * 7, (0.1, 1.0)),
        (FIRST_MESH_NUMBER, (0.12,) * 7, (1e-6, 0.02)),
    ],
    ids=["bare rock", "rock", "rover", "mesh of a user"],
)
def test_rocks_and_rovers_have_grain_and_meshes_slight_wear_where_there_is_texture(
    renderer: Renderer, name: int, amplitudes: tuple[float, ...], contrast: tuple[float, float]
) -> None:
    """The normals in the truth are those of the geometry."""
    sun, texture = Sun(direction(0.0, np.radians(40.0))), Texture(0.2, amplitudes)
    plate, ground = level_plate(name), flat_ground(64, 1.0)
    scene = Scene(ground, (8.0, 8.0), sun, LAMBERT, plate, object_texture=texture, **NEAR_MESH)
    frame = look_down(renderer, scene, (8.0, 8.0, 3.0), 0.5, 60)
    assert contrast[0] <= frame.radiance.std() / frame.radiance.mean() < contrast[1]
    assert frame.normal.reshape(-1, 3) == pytest.approx(np.tile([0.0, 0.0, 1.0], (3600, 1)), abs=1e-6)
