"""Tests of the sites and the world of the localisation scenario."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.localisation.map_parameters import MapParameters
from marsyard.scenarios.localisation.sites import localisation_site, localisation_sites
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.render import PixelRays, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.terrain import synthesise
from marsyard.sim.terrain.statistics import terrain_statistics


def test_sites_are_wider_than_a_map() -> None:
    assert {"crater-floor", "dunes", "highland", "plain"} <= set(localisation_sites())
    defaults = MapParameters()
    for site in localisation_sites().values():
        terrain = site.terrain()
        assert terrain.samples * terrain.spacing_m > defaults.side_px * defaults.pixel_m + 3000.0
        # textures end at cells of 1 to 2 mm
        finest_m = site.ground_texture.coarsest_m * 0.5 ** (len(site.ground_texture.amplitudes) - 1)
        assert 0.001 <= finest_m < 0.002


def test_unknown_site_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"no localisation site is called 'gusev'; allowed: crater-floor, dunes"):
        localisation_site("gusev")


def test_sites_differ_in_relief_and_contrast() -> None:
    # the same extent with an eighth of the samples along each axis
    changes = {"samples": 512, "spacing_m": 32.0, "crater_diameter_min_m": 128.0, "craters_per_km2": 1.0}
    statistics = {
        name: terrain_statistics(synthesise(localisation_site(name).terrain(changes=changes), np.random.default_rng(1)))
        for name in ("highland", "plain")
    }
    assert statistics["highland"].relief_m > 400.0
    assert statistics["plain"].relief_m < 0.3 * statistics["highland"].relief_m
    assert statistics["highland"].contrast > 3.0 * statistics["plain"].contrast


def test_scenes_for_different_heights_have_equal_ranges() -> None:
    """The scene for images from 2000 m shows the same surface as that for images from 500 m."""
    site = localisation_site("highland")
    terrain = site.terrain(changes={"samples": 512, "crater_diameter_max_m": 300.0})
    detector = DetectorParameters()
    world = LocalisationWorld.from_parameters(
        site,
        terrain,
        bank_seed=4,
        terrain_number=1,
        sun_azimuth_deg=120.0,
        sun_elevation_deg=50.0,
        optical_depth=0.3,
        detector=detector,
    )
    assert world.air.optical_depth == 0.3
    air = world.air
    expected = air.direct_fraction(np.radians(50.0)) * air.solar_irradiance / detector.sunlight
    np.testing.assert_allclose(world.brightness, expected)
    rays = PixelRays.from_camera(
        Cahv.from_field_of_view(np.radians(90.0), (128, 128), axis=(0.0, 0.0, -1.0), right=(1.0, 0.0, 0.0))
    )
    coarse, fine = (world.scene(500.0, 500.0, height_m, rays.pixel_rad) for height_m in (2000.0, 500.0))
    position = np.array([700.0, 600.0, float(world.surface.height(700.0, 600.0)) + 500.0])
    pose = rigid(Rotation.from_rotvec([0.15, 0.1, 0.4]), position)
    first, second = (process_renderer(default_backend()).render(scene, rays, pose) for scene in (coarse, fine))
    assert np.isfinite(first.range_m).all()
    difference = np.abs(first.range_m - second.range_m)
    # except 0.1 % of the pixels, at the edges of hidden slopes
    assert np.quantile(difference, 0.999) < 0.01
