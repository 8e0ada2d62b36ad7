"""`marsyard render`: what it writes fits together, and what cannot be is named."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from marsyard.cli import app as cli
from marsyard.cli.pictures import ENDINGS
from marsyard.sim.camera import read_cahvor

Command = Callable[..., tuple[int, str]]


@pytest.fixture
def marsyard(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Runs a command in this process; its status and what it says of errors."""

    def command(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["marsyard", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0), capfd.readouterr().err

    return command


def _check_picture(prefix: Path, size: tuple[int, int], multiple: int) -> None:
    """The files of one picture agree with each other."""
    columns, rows = size
    picture = cv2.imread(f"{prefix}.png", cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.dtype == np.uint16
    assert picture.shape == (rows, columns)
    assert (picture % multiple == 0).all()
    assert picture.std() > 0.0
    message = json.loads(Path(f"{prefix}.json").read_text())
    assert "# Frame: body" in Path(f"{prefix}.cahvor").read_text()
    camera = read_cahvor(f"{prefix}.cahvor").moved(RigidTransform.from_matrix(message["world_from_body"]))
    assert camera.size == size
    with np.load(f"{prefix}.npz") as truth:
        seen = np.isfinite(truth["range_m"])
        points = truth["point_m"][seen]
        # rays are kept in float32: 6e-8 of a focal length of about 1000 pixels, and of a range
        np.testing.assert_allclose(camera.project(points)[0], camera.pixel_grid()[seen], atol=2e-3)
        np.testing.assert_allclose(np.linalg.norm(points - camera.c, axis=1), truth["range_m"][seen], rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(truth["normal"][seen], axis=1), 1.0, atol=1e-4)
        to_sun = np.array(message["sun_direction"])
        to_eye = (camera.c - points) / truth["range_m"][seen][:, None]
        np.testing.assert_allclose(np.cos(np.radians(truth["phase_deg"][seen])), to_eye @ to_sun, atol=1e-5)
        assert ((truth["object"] == -2) == ~seen).all()
        assert (truth["object"] >= 0).any()
        assert 0.0 < truth["shadow"][seen].mean() < 0.5
        # faces turned away from the sun have no direct light
        assert truth["shadow"][seen][truth["normal"][seen] @ to_sun < -1e-3].all()
        np.testing.assert_allclose(truth["world_from_body"], message["world_from_body"])


def test_detector_picture_from_above(marsyard: Command, tmp_path: Path) -> None:
    prefix = tmp_path / "hover"
    status, message = marsyard("render", "heli-hazardous", "--camera", "xc-55", "--out", prefix, "--azimuth", 30)
    assert status == 0, message
    _check_picture(prefix, (640, 480), multiple=256)  # 8 bits in 16
    made_from = json.loads(Path(f"{prefix}.json").read_text())
    assert made_from["shot"]["altitude_m"] == 10.0
    assert made_from["detector"]["exposure_s"] == made_from["png"]["exposure_s"]


def test_stereo_pair_as_radiance(marsyard: Command, tmp_path: Path) -> None:
    prefix = tmp_path / "pair"
    options = ("--radiance", "--sun-elevation", 25, "--east", 12, "--north", -7)
    status, message = marsyard("render", "heli-hazardous", "--camera", "research-navcam", "--out", prefix, *options)
    assert status == 0, message
    for eye in ("left", "right"):
        _check_picture(tmp_path / f"pair-{eye}", (1024, 768), multiple=1)
    left, right = (read_cahvor(f"{prefix}-{eye}.cahvor") for eye in ("left", "right"))
    assert np.linalg.norm(left.c - right.c) == pytest.approx(0.2)
    picture = cv2.imread(f"{prefix}-left.png", cv2.IMREAD_UNCHANGED)
    with np.load(f"{prefix}-left.npz") as truth:
        radiance = truth["radiance_factor"]
    assert picture is not None
    np.testing.assert_allclose(picture / 65535.0, np.clip(radiance, 0.0, 1.0), atol=1.0 / 65535.0)


@pytest.mark.parametrize(
    ("site", "camera", "options", "message"),
    [
        ("gusef", "mer-navcam", (), "did you mean gusev?"),
        ("gusev", "navcam", (), "did you mean mer-navcam?"),
        ("gusev", "hasselblad", (), "no camera is called 'hasselblad'"),
        ("mars-yard", "mer-descent-flown", (), "with --scale: ground"),
        ("gusev", "mer-navcam", ("--scale", "orbit"), "with --scale: descent, ground"),
        ("gusev", "mer-navcam", ("--altitude", "0"), "--altitude 0 is out of range"),
        ("gusev", "mer-navcam", ("--altitude", "-3"), "--altitude -3 is out of range"),
        ("gusev", "mer-navcam", ("--altitude", "nan"), "--altitude nan is out of range"),
        ("gusev", "mer-navcam", ("--sun-elevation", "0"), "--sun-elevation 0 is out of range"),
        ("gusev", "mer-navcam", ("--elevation", "-91"), "--elevation -91 is out of range; allowed: -90 to 90"),
        ("gusev", "mer-navcam", ("--east", "inf"), "--east inf is not a finite number"),
    ],
)
def test_what_cannot_be_is_named(
    marsyard: Command, tmp_path: Path, site: str, camera: str, options: tuple[str, ...], message: str
) -> None:
    status, error = marsyard("render", site, "--camera", camera, "--out", tmp_path / "x", *options)
    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_folder_that_is_not_there_is_named(marsyard: Command, tmp_path: Path) -> None:
    status, error = marsyard("render", "gusev", "--camera", "xc-55", "--out", tmp_path / "no" / "x")
    assert status == 2
    assert "there is no folder" in error


@pytest.mark.parametrize("ending", ENDINGS)
def test_files_that_are_there_stay(marsyard: Command, tmp_path: Path, ending: str) -> None:
    kept = tmp_path / f"x{ending}"
    kept.write_text("mine")
    status, error = marsyard("render", "gusev", "--camera", "xc-55", "--out", tmp_path / "x")
    assert status == 2
    assert f"{kept}: there already" in error
    assert kept.read_text() == "mine"


def test_a_terrain_model_is_rendered_with_its_holes_marked(marsyard: Command, tmp_path: Path) -> None:
    """Seen from straight above the middle of its file, whose eastern quarter has no height."""
    heights = 3.0 * np.add.outer(np.sin(np.arange(120) / 7.0), np.cos(np.arange(120) / 9.0))
    heights[:, 90:] = np.nan
    dtm, prefix = tmp_path / "site.npz", tmp_path / "view"
    np.savez(dtm, dem=heights, dem_gsd=1.0)
    command = ("render", dtm, "--camera", "xc-55", "--altitude", 150, "--radiance", "--out", prefix)
    status, message = marsyard(*command)
    assert status == 2
    assert "25.0% of its posts have no height; allowed: up to 5.0%" in message
    status, message = marsyard(*command, "--max-holes", 0.3)
    assert status == 0, message
    assert "see filled holes of the DTM" in message
    with np.load(f"{prefix}.npz") as truth:
        filled, points = truth["filled"], truth["point_m"]
        assert filled.any()
        assert not filled.all()
        # 256 samples, the file's 119 m from 68 m (rounded) eastwards: no height from its post 90 on
        west = round(0.5 * (256 - 119))
        assert points[filled][:, 0].min() > west + 89.0
        np.testing.assert_allclose(np.nanmean(points[..., :2], axis=(0, 1)), 128.0, atol=3.0)
    made_from = json.loads(Path(f"{prefix}.json").read_text())
    assert made_from["filled_fraction"] == pytest.approx(float(filled.mean()))
    assert made_from["cahvor"]["frame"].startswith("body")
