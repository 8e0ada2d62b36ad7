"""Tests of custom cameras in campaigns: mounting preserves all angles, and a stored camera replaces its file."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from marsyard.sim.camera import Cahvor, mount_looking_down, read_camera
from marsyard.sim.sensor import CustomCamera, CustomCameraChoice, NamedOrCustomCamera
from tests.sim.camera.labels import EUROC

CHOICE: TypeAdapter[CustomCamera] = TypeAdapter(CustomCameraChoice)
NAMED_OR_CUSTOM: TypeAdapter[str | CustomCamera] = TypeAdapter(NamedOrCustomCamera)


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC)
    return path


def test_mounting_preserves_all_angles(euroc: Path) -> None:
    file_camera, custom = read_camera(euroc), CHOICE.validate_python({"file": str(euroc)})
    mounted_camera = custom.camera()
    assert np.array_equal(mounted_camera.a, [0.0, 0.0, -1.0])
    assert np.array_equal(mounted_camera.c, np.zeros(3))
    pixels = np.array([[0.0, 0.0], [751.0, 10.0], [400.0, 479.0], [100.0, 200.0]])
    actual, expected = (camera.rays(pixels)[1] for camera in (mounted_camera, file_camera))
    assert np.allclose(actual @ actual.T, expected @ expected.T, rtol=0, atol=1e-12)
    # Mounted axes: columns along +x, upper image edge along +y, viewing direction -z. OpenCV's y and z are inverted.
    point = np.array([0.1, -0.2, 1.0])
    expected_pixels, _ = cv2.projectPoints(
        point.reshape(1, 1, 3),
        np.zeros(3),
        np.zeros(3),
        np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1.0]]),
        np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
    )
    # The tolerance covers the fit, and the 0.01 deg tilt of A that the tangential distortion causes.
    assert np.allclose(mounted_camera.project(point * [1.0, -1.0, -1.0])[0], expected_pixels.ravel(), rtol=0, atol=0.2)


def test_mounting_an_opportunity_camera_preserves_all_angles(shared_data: Path) -> None:
    label = shared_data / "mer_opportunity" / "1N491020376ILFCNY9P0706L0M1.IMG"
    custom = CHOICE.validate_python(str(label))
    assert custom.model == "CAHVOR"
    assert custom.size == (1024, 1024)
    file_camera = read_camera(label)
    assert isinstance(file_camera, Cahvor)
    pixels = np.array([[0.0, 0.0], [1023.0, 10.0], [400.0, 900.0]])
    actual, expected = (camera.rays(pixels)[1] for camera in (custom.camera(), file_camera))
    # The label rounds A to six digits.
    assert np.allclose(actual @ actual.T, expected @ expected.T, rtol=0, atol=1e-6)


def test_stored_camera_replaces_the_file(euroc: Path) -> None:
    custom = CHOICE.validate_python(str(euroc))
    stored_values = custom.model_dump(mode="json")
    euroc.write_text("changed: true")
    assert CHOICE.validate_python(stored_values) == custom
    assert CHOICE.validate_json(custom.model_dump_json()) == custom
    assert hash(CHOICE.validate_python(stored_values)) == hash(custom)


def test_preset_names_are_accepted(euroc: Path) -> None:
    assert NAMED_OR_CUSTOM.validate_python("xc-55") == "xc-55"
    assert isinstance(NAMED_OR_CUSTOM.validate_python(str(euroc)), CustomCamera)
    assert isinstance(NAMED_OR_CUSTOM.validate_python({"file": str(euroc)}), CustomCamera)


def test_mirrored_images_are_rejected(euroc: Path) -> None:
    camera = read_camera(euroc)
    mirrored_camera = camera._with(h=-camera.h)
    with pytest.raises(ValueError, match="mirrored"):
        mount_looking_down(mirrored_camera)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ("absent.yaml", "absent.yaml: file: cannot be read"),
        ({"file": "FILE", "focal": 3}, "unknown key focal for a camera file; allowed: file, number"),
        ({"file": "FILE", "number": 1}, "number is 1; allowed: 0 to 0"),
        ({"file": "FILE", "subframe_folded_in": "false"}, "subframe_folded_in is 'false'; allowed: true or false"),
        ({"file": "FILE", "size": [640, 480]}, "size: 640 x 480; allowed: 752 x 480, the size in the file"),
        ({"model": "CAHVOR", "columns": 64, "rows": 64, "h": (1, 0, 0), "v": (0, 1, 0)}, "CAHVOR requires o and r"),
        (
            {
                "model": "CAHV",
                "columns": 64,
                "rows": 64,
                "h": (1, 0, 0),
                "v": (0, 1, 0),
                "r": (0, 0, 0),
                "linearity": 0,
            },
            "CAHV has no r and linearity",
        ),
    ],
)
def test_camera_errors_are_reported(euroc: Path, values: object, fault: str) -> None:
    if isinstance(values, dict) and values.get("file") == "FILE":
        values = {**values, "file": str(euroc)}
    with pytest.raises(ValidationError, match=fault):
        CHOICE.validate_python(values)
