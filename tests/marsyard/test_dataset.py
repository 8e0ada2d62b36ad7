"""Tests of data sets for machine learning: tar files of samples (shards), truth of each pixel, reproducible files."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.dataset import MANIFEST, _prepare_terrains
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.image_samples import interpolate_range
from marsyard.sim.camera import CameraModel, read_cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, PixelRays
from marsyard.sim.sensor import preset
from tests.command import run_command

CAMPAIGN = """name = "samples"
scenario = "landing"
cases = 2
seed = 3

[parameters]
site = "heli-hazardous"

[parameters.terrain]
samples = 512

[parameters.location]
bank = 1

[parameters.lander]
diameter_m = 1.0

[dispersions]
"location.east_m" = { distribution = "uniform", low = 0.0, high = 20.0, source = "anywhere" }
"image_poses.tilt_deg" = { distribution = "uniform", low = 0.0, high = 5.0, source = "assumed" }
"""


def run_dataset(folder: Path, *arguments: str) -> tuple[int, str]:
    (folder / "samples.toml").write_text(CAMPAIGN)
    return run_command("dataset", folder / "samples.toml", "--out", folder / "set", "--shard", 1, *arguments)


def read_shard(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as shard:
        return {member.name: shard.extractfile(member).read() for member in shard.getmembers()}


def test_folder_with_another_file_of_the_manifests_name_is_reported(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / MANIFEST).write_text("[]")
    status, output = run_dataset(tmp_path)
    assert status == 2
    assert "is not the manifest of a data set" in output


def test_only_terrains_of_several_cases_are_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six cases on four terrains in turn: two terrains are used twice."""
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "samples.toml"
    dispersion = '"location.terrain" = { distribution = "in-turn", low = 0, high = 3, source = "any" }'
    path.write_text(CAMPAIGN.replace("bank = 1", "bank = 20").replace("samples = 512", "samples = 256") + dispersion)
    _prepare_terrains(load_campaign(str(path)), range(6))
    assert len(list((tmp_path / "cache" / "terrain").iterdir())) == 2


def compute_points(sample: dict[str, Any], camera_file: Path, distance: np.ndarray) -> np.ndarray:
    """Compute world points (m) of the pixels from the pose of a sample, its camera and ranges `distance` (m)."""
    camera = read_cahvor(camera_file)
    origins, directions = camera.rays(camera.pixel_grid())
    world_from_body = Rotation.from_quat(sample["world_from_body_xyzw"])
    body_points = (origins + distance[..., None] * directions).reshape(-1, 3)
    return (np.array(sample["position_m"]) + world_from_body.apply(body_points)).reshape(*distance.shape, 3)


@pytest.mark.slow
def test_samples_contain_pixel_truth_and_are_reproducible(tmp_path: Path) -> None:
    status, output = run_dataset(tmp_path)
    assert status == 0, output
    shards = sorted((tmp_path / "set").glob("*.tar"))
    assert [path.name for path in shards] == ["shard-000000.tar", "shard-000001.tar"]
    files = read_shard(shards[1])
    # one case per shard; samples are named by case and image
    assert {name.partition(".")[0] for name in files} == {"0000001-0", "0000001-1"}

    sample = json.loads(files["0000001-0.json"])
    image, rocks, hazard = (
        np.asarray(cv2.imdecode(np.frombuffer(files[f"0000001-0.{name}.png"], np.uint8), cv2.IMREAD_UNCHANGED))
        for name in ("image", "rocks", "hazard")
    )
    distance, normal = (np.load(io.BytesIO(files[f"0000001-0.{name}.npy"])) for name in ("range", "normal"))
    assert image.dtype == np.uint16
    assert image.shape == rocks.shape == hazard.shape == distance.shape == normal.shape[:2]
    assert np.allclose(np.linalg.norm(normal, axis=2), 1.0, atol=1e-3)
    assert set(np.unique(rocks)) == {0, 1}
    # safe, hazard, unknown
    assert set(np.unique(hazard)) <= {0, 1, 255}
    assert 0 in hazard

    # normals from the world points of neighbouring pixels, compared with the stored normals
    path = tmp_path / "camera.cahvor"
    path.write_bytes(files["0000001-0.cahvor"])
    points = compute_points(sample, path, distance)
    without_rocks = rocks[:-1, :-1] + rocks[1:, :-1] + rocks[:-1, 1:] == 0
    x_step, y_step = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    computed_normal = np.cross(y_step, x_step)
    computed_normal /= np.linalg.norm(computed_normal, axis=2, keepdims=True)
    cosine = np.sum(computed_normal * normal[:-1, :-1], axis=2)[without_rocks]
    assert np.median(cosine) > 0.99

    assert 0.0 <= sample["dispersed_parameters"]["location.east_m"] <= 20.0
    assert sample["image_index"] == 0
    # an interrupted data set is completed with identical files
    contents_before = [path.read_bytes() for path in shards]
    shards[0].unlink()
    assert run_dataset(tmp_path)[0] == 0
    assert [path.read_bytes() for path in shards] == contents_before
    status, output = run_dataset(tmp_path, "--seed", "4")
    assert status == 2
    assert "contains another data set (definition_sha256 differs)" in output


def test_range_with_summed_rows_is_that_along_the_delivered_rays() -> None:
    """Level ground 100 m below a camera that is tilted by 40 deg; half a row changes the range by 5e-4."""
    camera = preset("xc-55").cameras()[0]
    tilt = Rotation.from_euler("x", 40.0, degrees=True)

    def compute_range(model: CameraModel) -> np.ndarray:
        return -100.0 / tilt.apply(model.rays(model.pixel_grid())[1].reshape(-1, 3))[:, 2].reshape(model.size[::-1])

    distance, layer = compute_range(camera), np.zeros(camera.size[::-1], dtype=np.float32)
    normal, body = np.zeros((*layer.shape, 3), dtype=np.float32), layer.astype(np.int32)
    frame = Frame(layer, distance, body, normal, rigid(tilt, np.zeros(3)), PixelRays.from_camera(camera))
    np.testing.assert_allclose(interpolate_range(frame, 4), compute_range(camera.bin(columns=1, rows=4)), rtol=3e-6)
    np.testing.assert_allclose(interpolate_range(frame, 3), compute_range(camera.bin(columns=1, rows=3)), rtol=3e-6)


@pytest.mark.slow
def test_descent_sample_has_three_images(tmp_path: Path) -> None:
    overrides = ["terrain.samples=512", "location.bank=8"]
    arguments = [argument for override in overrides for argument in ("--set", override)]
    out = tmp_path / "set"
    status, output = run_command("dataset", "dimes-smoke", "-n", 1, "--jobs", 1, "--out", out, *arguments)
    assert status == 0, output
    files = read_shard(out / "shard-000000.tar")
    kinds = {name.partition(".")[2] for name in files}
    assert kinds == {"image.png", "range.npy", "normal.npy", "rocks.png", "cahvor", "json"}
    assert {name.partition(".")[0] for name in files} == {f"0000000-{number}" for number in range(3)}

    campaign = load_campaign("dimes-smoke", overrides)
    parameters = campaign.parameters(0)
    assert isinstance(parameters, DescentScenarioParameters)
    surface = DescentWorld.from_parameters(parameters).surface
    path = tmp_path / "camera.cahvor"
    for number in range(3):
        sample = json.loads(files[f"0000000-{number}.json"])
        path.write_bytes(files[f"0000000-{number}.cahvor"])
        distance = np.load(io.BytesIO(files[f"0000000-{number}.range.npy"]))
        points = compute_points(sample, path, distance)
        is_visible = np.isfinite(distance)
        assert is_visible.mean() > 0.9
        x, y, z = points[is_visible].T
        # the level of detail smooths the terrain over one pixel, about 2 m at 2000 m range
        assert np.median(abs(z - surface.height(x, y))) < 0.2
        # descents at about 75 m/s
        assert sample["velocity_m_s"][2] < -60.0


def test_scenarios_without_samples_are_rejected(tmp_path: Path) -> None:
    status, output = run_command("dataset", "vtt-montecarlo", "--out", tmp_path / "set")
    assert (status, "provides no training samples; allowed: descent, landing" in output) == (2, True)


@pytest.mark.parametrize("arguments", [("--shard", "0"), ("--jobs", "0")])
def test_invalid_numbers_are_rejected(tmp_path: Path, arguments: tuple[str, str]) -> None:
    assert run_dataset(tmp_path, *arguments)[0] == 2
