"""A user's own camera in a campaign: mounted without a change of what it sees, and read once."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from marsyard.sim.camera import Cahvor, mount_looking_down, read_camera
from marsyard.sim.sensor import CustomCamera, CustomCameraChoice, NamedOrCustomCamera

CHOICE: TypeAdapter[CustomCamera] = TypeAdapter(CustomCameraChoice)
EITHER: TypeAdapter[str | CustomCamera] = TypeAdapter(NamedOrCustomCamera)
#: EuRoC's first camera (its sensor.yaml), of the fields that are read.
EUROC = """resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC)
    return path


def test_mounting_changes_no_angle(euroc: Path) -> None:
    read, own = read_camera(euroc), CHOICE.validate_python({"file": str(euroc)})
    mounted = own.camera()
    assert np.array_equal(mounted.a, [0.0, 0.0, -1.0])
    assert np.array_equal(mounted.c, np.zeros(3))
    pixels = np.array([[0.0, 0.0], [751.0, 10.0], [400.0, 479.0], [100.0, 200.0]])
    ours, theirs = (camera.rays(pixels)[1] for camera in (mounted, read))
    assert np.allclose(ours @ ours.T, theirs @ theirs.T, rtol=0, atol=1e-12)
    # columns along +x, the picture's upper edge along +y, down is -z: OpenCV's y and z turned over
    point = np.array([0.1, -0.2, 1.0])
    there, _ = cv2.projectPoints(
        point.reshape(1, 1, 3),
        np.zeros(3),
        np.zeros(3),
        np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1.0]]),
        np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
    )
    # to the fit and the tilt of A that decentring asks for, 0.01 deg
    assert np.allclose(mounted.project(point * [1.0, -1.0, -1.0])[0], there.ravel(), rtol=0, atol=0.2)


def test_labels_of_opportunity_can_be_mounted(shared_data: Path) -> None:
    label = shared_data / "mer_opportunity" / "1N491020376ILFCNY9P0706L0M1.IMG"
    own = CHOICE.validate_python(str(label))
    assert own.model == "CAHVOR"
    assert own.size == (1024, 1024)
    read = read_camera(label)
    assert isinstance(read, Cahvor)
    pixels = np.array([[0.0, 0.0], [1023.0, 10.0], [400.0, 900.0]])
    ours, theirs = (camera.rays(pixels)[1] for camera in (own.camera(), read))
    # the label rounds A to six digits
    assert np.allclose(ours @ ours.T, theirs @ theirs.T, rtol=0, atol=1e-6)


def test_what_was_read_stands_for_the_file(euroc: Path) -> None:
    own = CHOICE.validate_python(str(euroc))
    stored = own.model_dump(mode="json")
    euroc.write_text("changed: true")
    assert CHOICE.validate_python(stored) == own
    assert CHOICE.validate_json(own.model_dump_json()) == own
    assert hash(CHOICE.validate_python(stored)) == hash(own)


def test_names_stay_names(euroc: Path) -> None:
    assert EITHER.validate_python("xc-55") == "xc-55"
    assert isinstance(EITHER.validate_python(str(euroc)), CustomCamera)
    assert isinstance(EITHER.validate_python({"file": str(euroc)}), CustomCamera)


def test_mirrored_pictures_are_refused(euroc: Path) -> None:
    camera = read_camera(euroc)
    mirrored = camera._with(h=-camera.h)
    with pytest.raises(ValueError, match="mirrored"):
        mount_looking_down(mirrored)


@pytest.mark.parametrize(
    ("stated", "fault"),
    [
        ("absent.yaml", "absent.yaml: file: cannot be read"),
        ({"file": "FILE", "focal": 3}, "leaves nothing else to state than file, number.*focal"),
        ({"file": "FILE", "number": 1}, "holds 1 cameras; number may be 0 to 0"),
        ({"model": "CAHVOR", "columns": 64, "rows": 64, "h": (1, 0, 0), "v": (0, 1, 0)}, "CAHVOR needs o and r"),
    ],
)
def test_faults(euroc: Path, stated: object, fault: str) -> None:
    if isinstance(stated, dict) and stated.get("file") == "FILE":
        stated = {**stated, "file": str(euroc)}
    with pytest.raises(ValidationError, match=fault):
        CHOICE.validate_python(stated)
