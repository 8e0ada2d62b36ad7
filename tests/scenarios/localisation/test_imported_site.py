"""Tests of localisation over an imported DTM with an orthoimage."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rasterio.transform import Affine
from scipy.ndimage import gaussian_filter

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.scenario import LocalisationScenario
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.user_files import input_files
from marsyard.sim.streams import Streams
from tests.scenarios.localisation.test_scenario import COARSE, EXACT_MAP, SMALL
from tests.scenarios.test_terrain_files import write_tif

#: Posting of heights and orthoimage, and sides of the DTM in posts along x and y.
POST_M, ORTHO_M, COLUMNS, ROWS = 24.0, 12.0, 140, 120
#: Terrain of 12.3 km, whose centre is the centre of the DTM.
TERRAIN: dict[str, Any] = {"samples": 1024, "spacing_m": 12.0, "crater_diameter_min_m": 48.0, "craters_per_km2": 6.0}
CENTRE_M = 6144.0
#: Brightness of the orthoimage's eastern half, relative to its western half.
EAST_BRIGHTNESS = 1.6


@cache
def _heights() -> np.ndarray:
    """Return smooth hills with an amplitude of about 30 m; row 0 is the northernmost."""
    noise = gaussian_filter(np.random.default_rng(1).standard_normal((ROWS, COLUMNS)), 6.0, mode="wrap")
    return (30.0 / noise.std() * noise).astype(np.float32)


def _write_site(folder: Path, *, posting_m: float = POST_M) -> dict[str, str]:
    """Write a DTM and an orthoimage with a bright eastern half and texture of 12 m; return the table of the source."""
    folder.mkdir(exist_ok=True)
    # map coordinates of the north-western corner, m
    corner = (8_142_406.0, -276_455.0)
    dtm = write_tif(
        folder, values=_heights() - 4450.0, transform=Affine(posting_m, 0, corner[0], 0, -posting_m, corner[1])
    )
    texture = np.exp(0.1 * np.random.default_rng(2).standard_normal((2 * ROWS, 2 * COLUMNS)))
    brightness = 100.0 * texture * np.where(np.arange(2 * COLUMNS) >= COLUMNS, EAST_BRIGHTNESS, 1.0)
    half_m = 0.5 * posting_m
    ortho = write_tif(
        folder, "ortho.tif", values=brightness.astype(np.float32), nodata=0.0,
        transform=Affine(half_m, 0, corner[0], 0, -half_m, corner[1]),
    )  # fmt: skip
    return {"dtm": str(dtm), "ortho": str(ortho)}


def _settings(source: dict[str, str], **changes: Any) -> dict[str, Any]:
    location = {"bank": 1, "east_m": CENTRE_M, "north_m": CENTRE_M}
    terrain = {**TERRAIN, "source": source}
    return {**SMALL, "site": "plain", "location": location, "terrain": terrain, **changes}


def test_map_and_images_show_the_imported_ground(tmp_path: Path) -> None:
    """Without errors of the map, its elevation is the DTM's, and its appearance is that of the orthoimage."""
    source = _write_site(tmp_path)
    parameters = LocalisationScenarioParameters.model_validate(
        _settings(
            source,
            map={"side_px": 256, "optical_depth": 0.0, **EXACT_MAP},
            dust_opacity=0.0,
            camera=COARSE["camera"],
            exact_instruments=True,
        )
    )
    assert set(source.values()) <= set(input_files(parameters))
    descent = LocalisedDescent.simulate(parameters, Streams(1, "loc imported", 0))
    product = descent.measurements.map_product
    x, y = (start + product.pixel_m * np.arange(256) for start in product.origin_m)
    # posts of the DTM in the terrain, from its south-western post; row 0 of the file is the northernmost
    west, south = CENTRE_M - 0.5 * (COLUMNS - 1) * POST_M, CENTRE_M - 0.5 * (ROWS - 1) * POST_M
    columns, rows = np.rint((x - west) / POST_M).astype(int), np.rint((y - south) / POST_M).astype(int)
    posts = (_heights()[::-1] - _heights().mean())[np.ix_(rows, columns)]
    # differences: half a post and half a sample of hills with slopes of some degrees, and fine relief
    np.testing.assert_allclose(np.corrcoef(product.elevation_m.ravel(), posts.ravel())[0, 1], 1.0, atol=0.02)
    assert np.abs(product.elevation_m - posts).mean() < 3.0
    # the columns near the edge of brightness are left out; slopes change the mean light of a half by some per cent
    east, west_half = (product.appearance[:, half].mean() for half in (slice(140, None), slice(None, 116)))
    assert east / west_half == pytest.approx(EAST_BRIGHTNESS, rel=0.1)
    # images and map have the same surface
    height = descent.world.surface.height(x[None, :], y[:, None])
    np.testing.assert_allclose(product.elevation_m, height, atol=1e-2)
    image, state = descent.images[-1], descent.states[-1]
    pixels = np.stack(np.meshgrid(np.arange(16.0, 48.0), np.arange(16.0, 48.0)), axis=-1)
    rays = state.attitude.apply(image.camera.rays(pixels.reshape(-1, 2))[1])
    above_m = state.position_m[2] - descent.world.surface.height(*state.position_m[:2])
    is_east = state.position_m[0] - above_m * rays[:, 0] / rays[:, 2] > CENTRE_M
    counts = image.counts[16:48, 16:48].ravel() - float(image.calibration.offset_dn)
    # at least 100 of the 32 x 32 pixels are in each half
    assert 100 < np.count_nonzero(is_east) < 924
    assert counts[is_east].mean() / counts[~is_east].mean() == pytest.approx(EAST_BRIGHTNESS, rel=0.1)


def test_lander_is_located_on_the_imported_ground(tmp_path: Path) -> None:
    parameters = LocalisationScenarioParameters.model_validate(_settings(_write_site(tmp_path)))
    result = LocalisationScenario().run(parameters, Streams(1, "loc imported", 0))
    row: Any = result.row
    assert (result.outcome, row["false_fix"]) == ("VALID", False)
    # two pixels of the image
    assert row["position_error_m"] < 20.0


def test_terrain_and_files_of_a_wrong_size_are_rejected(tmp_path: Path) -> None:
    source = _write_site(tmp_path)
    small, large = _write_site(tmp_path / "small", posting_m=2.0), _write_site(tmp_path / "large", posting_m=100.0)
    cases: list[tuple[dict[str, Any], str]] = [
        (_settings(source, terrain={**TERRAIN, "samples": 512, "source": source}), r"repeats after 6144 m; .* 12000 m"),
        # the camera's field of 90 deg shows 2100 m from 1050 m
        (
            _settings(small),
            r"dtm.tif: covers 278 m x 238 m; allowed: at least 2140 m along each side: the last image shows",
        ),
        (_settings(large), r"dtm.tif: covers 13900 m x 11900 m; allowed: at most 12264 m along each side: extract"),
        (_settings({**source, "dtm": str(tmp_path / "no.tif")}), r"no.tif: no such file"),
        (_settings({**source, "ortho": str(tmp_path / "no.tif")}), r"no.tif: no such file"),
        (_settings(source, faults={"wrong_map": 1}), r"faults.wrong_map needs another terrain; all terrains with"),
    ]
    for values, message in cases:
        with pytest.raises(ValidationError, match=message) as caught:
            LocalisationScenarioParameters.model_validate(values)
        assert caught.value.error_count() == 1


def test_example_accepts_a_valid_site(tmp_path: Path) -> None:
    example = Path(__file__).parents[3] / "docs" / "examples" / "loc-imported.toml"
    source = _write_site(tmp_path)
    campaign = load_campaign(str(example), [f"terrain.source.{name}={path}" for name, path in source.items()])
    parameters = campaign.parameters(3)
    assert isinstance(parameters, LocalisationScenarioParameters)
    # the example varies the position by 500 m around the centre of its terrain
    assert abs(parameters.location.east_m - 8192.0) <= 500.0
