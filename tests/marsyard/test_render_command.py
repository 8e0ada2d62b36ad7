"""Tests of `marsyard render`: consistent image, camera and truth files; invalid options."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard import site_images
from marsyard.image_files import SUFFIXES, truth_layers
from marsyard.sim.camera import read_cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.kernel_cache import mark_ready
from marsyard.sim.render import DustySky, Objects, Photometry, PixelRays, Scene, Sun, process_renderer, scene
from marsyard.sim.render.backend import RenderingError, default_backend
from marsyard.sim.render.casters import Casters, casters_towards
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import Surface
from marsyard.site_images import RenderedImage
from tests.command import marsyard


def _check_image(prefix: Path, size: tuple[int, int], multiple: int) -> None:
    """Check that image, camera model, metadata and truth files agree; pixel values are multiples of `multiple`."""
    columns, rows = size
    image = cv2.imread(f"{prefix}.png", cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == np.uint16
    assert image.shape == (rows, columns)
    assert (image % multiple == 0).all()
    assert image.std() > 0.0
    metadata = json.loads(Path(f"{prefix}.json").read_text())
    assert "# Frame: body" in Path(f"{prefix}.cahvor").read_text()
    camera = read_cahvor(f"{prefix}.cahvor").transform(RigidTransform.from_matrix(metadata["world_from_body"]))
    assert camera.size == size
    with np.load(f"{prefix}.npz") as truth:
        is_surface = np.isfinite(truth["range_m"])
        points = truth["point_m"][is_surface]
        # float32 rays: relative error 6e-8 at a focal length of about 1000 pixels
        np.testing.assert_allclose(camera.project(points)[0], camera.pixel_grid()[is_surface], atol=2e-3)
        np.testing.assert_allclose(np.linalg.norm(points - camera.c, axis=1), truth["range_m"][is_surface], rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(truth["normal"][is_surface], axis=1), 1.0, atol=1e-4)
        to_sun = np.array(metadata["sun_direction"])
        to_eye = (camera.c - points) / truth["range_m"][is_surface][:, None]
        np.testing.assert_allclose(np.cos(np.radians(truth["phase_deg"][is_surface])), to_eye @ to_sun, atol=1e-5)
        # number of the body; -1: ground, -2: sky
        assert ((truth["object"] == -2) == ~is_surface).all()
        assert (truth["object"] >= 0).any()
        assert 0.0 < truth["shadow"][is_surface].mean() < 0.5
        # surfaces that face away from the sun are in shadow; micro-relief, which normals omit, tilts by a few degrees
        assert truth["shadow"][is_surface][truth["normal"][is_surface] @ to_sun < -0.05].all()
        np.testing.assert_allclose(truth["world_from_body"], metadata["world_from_body"])


def test_truth_layer_contains_shadows_in_the_light_of_the_aureole() -> None:
    """The shadow of a horizontal triangle, 3 m above level ground, is the triangle moved away from the sun."""
    corners = np.array([[-2.0, -2.0, 3.0], [3.0, -1.0, 3.0], [0.0, 2.0, 3.0]])
    up, numbers = np.tile([0.0, 0.0, 1.0], (3, 1)), np.zeros(1, dtype=np.int32)
    triangle = Objects.of_mesh(corners, up, np.array([[0, 1, 2]], dtype=np.int32), numbers, 0.2)
    samples = np.broadcast_to(np.array([0.0, 0.2], dtype=np.float32), (64, 64, 2))
    sun = Sun(np.array([0.48, 0.64, 0.6]))
    light = Photometry(sky_fraction=0.3, sky=DustySky(0.9, 0.95, 0.65))
    view = Scene(Surface.from_samples(samples, 1.0), (0.0, 0.0), sun, light, objects=triangle)
    camera, pose = preset("xc-55").cameras()[0], rigid(Rotation.identity(), np.array([0.0, 0.0, 20.0]))
    frame = process_renderer(default_backend()).render(view, PixelRays.from_camera(camera), pose)
    layers = truth_layers(RenderedImage("", camera, camera, frame, view, None, None, None))
    # barycentric weights of the points at which the rays to the sun pass the triangle's height
    ground = layers["object"] == -1
    crossings = layers["point_m"][ground][:, :2] + 3.0 / sun.direction[2] * sun.direction[:2]
    weights = np.linalg.solve(np.vstack([corners[:, :2].T, np.ones(3)]), np.column_stack([crossings, ground[ground]]).T)
    is_shaded, near_edge = weights.min(axis=0) > 0.0, np.abs(weights.min(axis=0)) < 0.01
    assert is_shaded.sum() > 1000
    np.testing.assert_array_equal(layers["shadow"][ground][~near_edge], is_shaded[~near_edge])


@pytest.mark.slow
def test_detector_image_from_above_is_consistent(tmp_path: Path) -> None:
    prefix = tmp_path / "hover"
    status, _, message = marsyard("render", "heli-hazardous", "--camera", "xc-55", "--out", prefix, "--azimuth", 30)
    assert status == 0, message
    _check_image(prefix, (640, 480), multiple=256)  # 8-bit counts in a 16-bit file
    metadata = json.loads(Path(f"{prefix}.json").read_text())
    assert metadata["shot"]["altitude_m"] == 10.0
    assert metadata["detector"]["exposure_s"] == metadata["png"]["exposure_s"]


@pytest.mark.slow
def test_stereo_pair_of_radiance_is_consistent(tmp_path: Path) -> None:
    prefix = tmp_path / "pair"
    options = ("--radiance", "--sun-elevation", 25, "--east", 12, "--north", -7)
    status, _, message = marsyard("render", "heli-hazardous", "--camera", "research-navcam", "--out", prefix, *options)
    assert status == 0, message
    for eye in ("left", "right"):
        _check_image(tmp_path / f"pair-{eye}", (1024, 768), multiple=1)
    left, right = (read_cahvor(f"{prefix}-{eye}.cahvor") for eye in ("left", "right"))
    assert np.linalg.norm(left.c - right.c) == pytest.approx(0.2)
    image = cv2.imread(f"{prefix}-left.png", cv2.IMREAD_UNCHANGED)
    with np.load(f"{prefix}-left.npz") as truth:
        radiance = truth["radiance_factor"]
    assert image is not None
    np.testing.assert_allclose(image / 65535.0, np.clip(radiance, 0.0, 1.0), atol=1.0 / 65535.0)


@pytest.mark.parametrize(
    ("site", "camera", "options", "message"),
    [
        ("gusef", "mer-navcam", (), "did you mean gusev?"),
        ("gusev", "navcam", (), "did you mean mer-navcam?"),
        ("gusev", "hasselblad", (), "no camera is called 'hasselblad'"),
        ("mars-yard", "mer-descent-flown", (), "allowed --scale: ground"),
        ("gusev", "mer-navcam", ("--scale", "orbit"), "allowed --scale: descent, ground"),
        ("gusev", "mer-navcam", ("--altitude", "0"), "--altitude 0 is out of range"),
        ("gusev", "mer-navcam", ("--altitude", "-3"), "--altitude -3 is out of range"),
        ("gusev", "mer-navcam", ("--altitude", "nan"), "--altitude nan is out of range"),
        ("gusev", "mer-navcam", ("--sun-elevation", "0"), "--sun-elevation 0 is out of range"),
        ("gusev", "mer-navcam", ("--elevation", "-91"), "--elevation -91 is out of range; allowed: -90 to 90"),
        ("gusev", "mer-navcam", ("--east", "inf"), "--east inf is not a finite number"),
        ("gusev", "mer-navcam", ("--out", "no/such/folder/x"), "the folder no/such/folder does not exist"),
    ],
)
def test_invalid_options_are_rejected(
    tmp_path: Path, site: str, camera: str, options: tuple[str, ...], message: str
) -> None:
    status, _, error = marsyard("render", site, "--camera", camera, "--out", tmp_path / "x", *options)
    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_existing_files_are_kept(tmp_path: Path, suffix: str) -> None:
    existing = tmp_path / f"x{suffix}"
    existing.write_text("existing text")
    status, _, error = marsyard("render", "gusev", "--camera", "xc-55", "--out", tmp_path / "x")
    assert status == 2
    assert f"{existing}: files exist" in error
    assert existing.read_text() == "existing text"


def test_filled_holes_of_a_dtm_are_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera looks down at the centre of a DTM whose eastern quarter has no heights."""
    heights = 3.0 * np.add.outer(np.sin(np.arange(120) / 7.0), np.cos(np.arange(120) / 9.0))
    heights[:, 90:] = np.nan
    dtm, prefix = tmp_path / "site.npz", tmp_path / "view"
    np.savez(dtm, dem=heights, dem_gsd=1.0)
    command = ("render", dtm, "--camera", "xc-55", "--altitude", 150, "--radiance", "--out", prefix)
    status, _, message = marsyard(*command)
    assert status == 2
    assert "25.0% of its posts have no height; allowed: up to 5.0%" in message
    calls: list[Sun] = []

    def count_calls(objects: Objects, sun: Sun) -> Casters | None:
        calls.append(sun)
        return casters_towards(objects, sun)

    monkeypatch.setattr(scene, "casters_towards", count_calls)
    status, _, message = marsyard(*command, "--max-holes", 0.3)
    assert status == 0, message
    assert "show filled holes of the DTM" in message
    # image and truth layers have the same shadows
    assert len(calls) == 1
    # a line at the start of each stage
    stages = [line for line in message.splitlines() if not line.startswith("note: ")]
    assert stages == [f"terrain and rocks of {dtm}", "image 1 of 1", "ground truth and files"]
    with np.load(f"{prefix}.npz") as truth:
        is_filled, points = truth["filled"], truth["point_m"]
        assert is_filled.any()
        assert not is_filled.all()
        # the DTM of 119 m is centred in 256 m; posts from column 90 have no height
        west_edge_m = round(0.5 * (256 - 119))
        assert points[is_filled][:, 0].min() > west_edge_m + 89.0
        np.testing.assert_allclose(np.nanmean(points[..., :2], axis=(0, 1)), 128.0, atol=3.0)
    metadata = json.loads(Path(f"{prefix}.json").read_text())
    assert metadata["filled_fraction"] == pytest.approx(float(is_filled.mean()))
    assert metadata["cahvor"]["frame"].startswith("body")


@pytest.mark.parametrize("compiled_by", [None, "render", "descent"])
def test_first_compilation_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled_by: str | None) -> None:
    """Without compiled kernels, the note precedes rendering, which is replaced here by an error."""

    def fail(*_arguments: object, **_options: object) -> None:
        raise RenderingError("stopped")

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(site_images, "render_images", fail)
    if compiled_by is not None:
        mark_ready(compiled_by)
    status, _, message = marsyard("render", "heli-benign", "--camera", "xc-55", "--out", tmp_path / "x")
    assert status == 2
    is_noted = message.startswith("note: compiling numeric kernels once on this machine")
    assert is_noted == (compiled_by is None)
    assert message.endswith("error: stopped\n")
