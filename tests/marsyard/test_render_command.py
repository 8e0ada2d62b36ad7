"""`marsyard render`: what it writes fits together, and what cannot be is named."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from marsyard import cli
from marsyard.render_command import ENDINGS
from sim.camera import read_cahvor

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
    camera = read_cahvor(f"{prefix}.cahvor")
    assert camera.size == size
    said = json.loads(Path(f"{prefix}.json").read_text())
    with np.load(f"{prefix}.npz") as truth:
        seen = np.isfinite(truth["range_m"])
        points = truth["point_m"][seen]
        # rays are kept in float32: 6e-8 of a focal length of about 1000 pixels, and of a range
        np.testing.assert_allclose(camera.project(points)[0], camera.pixel_grid()[seen], atol=2e-3)
        np.testing.assert_allclose(np.linalg.norm(points - camera.c, axis=1), truth["range_m"][seen], rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(truth["normal"][seen], axis=1), 1.0, atol=1e-4)
        to_sun = np.array(said["sun_direction"])
        to_eye = (camera.c - points) / truth["range_m"][seen][:, None]
        np.testing.assert_allclose(np.cos(np.radians(truth["phase_deg"][seen])), to_eye @ to_sun, atol=1e-5)
        assert ((truth["object"] == -2) == ~seen).all()
        assert (truth["object"] >= 0).any()
        assert 0.0 < truth["shadow"][seen].mean() < 0.5
        # faces turned away from the sun have no direct light
        assert truth["shadow"][seen][truth["normal"][seen] @ to_sun < -1e-3].all()
        np.testing.assert_allclose(truth["world_from_body"], said["world_from_body"])


def test_detector_picture_from_above(marsyard: Command, tmp_path: Path) -> None:
    prefix = tmp_path / "hover"
    status, said = marsyard("render", "heli-hazardous", "--camera", "xc-55", "--out", prefix, "--azimuth", 30)
    assert status == 0, said
    _check_picture(prefix, (640, 480), multiple=256)  # 8 bits in 16
    made_from = json.loads(Path(f"{prefix}.json").read_text())
    assert made_from["shot"]["altitude_m"] == 10.0
    assert made_from["detector"]["exposure_s"] == made_from["png"]["exposure_s"]


def test_stereo_pair_as_radiance(marsyard: Command, tmp_path: Path) -> None:
    prefix = tmp_path / "pair"
    options = ("--radiance", "--sun-elevation", 25, "--east", 12, "--north", -7)
    status, said = marsyard("render", "heli-hazardous", "--camera", "research-navcam", "--out", prefix, *options)
    assert status == 0, said
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
    ("site", "camera", "options", "said"),
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
    marsyard: Command, tmp_path: Path, site: str, camera: str, options: tuple[str, ...], said: str
) -> None:
    status, error = marsyard("render", site, "--camera", camera, "--out", tmp_path / "x", *options)
    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert said in error
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
