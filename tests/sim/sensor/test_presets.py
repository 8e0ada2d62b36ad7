"""Tests of cameras: fields of view, baselines and signal levels of presets; mounting and storage of custom cameras."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from marsyard.sim.camera import Cahv, Cahvor, mount_looking_down, read_camera
from marsyard.sim.sensor import (
    PRESETS,
    CustomCamera,
    CustomCameraChoice,
    Detector,
    DetectorChoice,
    DetectorParameters,
    NamedOrCustomCamera,
    natural_fall_off,
    preset,
)
from tests.sim.camera.labels import EUROC


class _Campaign(BaseModel):
    """Parameters with a detector that is a preset, or a preset with changed values."""

    detector: DetectorChoice = DetectorParameters()


def _compute_fields_of_view_deg(name: str) -> tuple[float, float]:
    """Compute the angles between the centres of opposite image edges, deg."""
    camera = preset(name).cameras()[0]
    columns, rows = camera.size
    u, v = (columns - 1) / 2, (rows - 1) / 2
    _, edge_rays = camera.rays(np.array([[-0.5, v], [columns - 0.5, v], [u, -0.5], [u, rows - 0.5]]))
    horizontal, vertical = np.degrees(np.arccos([edge_rays[0] @ edge_rays[1], edge_rays[2] @ edge_rays[3]]))
    return float(horizontal), float(vertical)


@pytest.mark.parametrize(
    ("name", "horizontal_deg", "vertical_deg", "tolerance"),
    [
        ("mer-descent-flown", 45.0, 45.0, 1.0),
        ("mer-descent-field", 45.0, 45.0, 1.0),
        ("mer-navcam", 45.0, 45.0, 1.0),
        # 1024 pixels of 12 um, focal length 5.58 mm: 126 deg for an equidistant lens.
        ("mer-hazcam", 124.0, 124.0, 3.0),
        # The fields of view of the tracking paper are those of 4.8 mm x 3.6 mm; the preset has pixels of 4.65 um.
        ("research-navcam", 49.0, 37.0, 6.0),
        ("research-pancam", 17.0, 13.0, 0.5),
    ],
)
def test_presets_have_fields_of_view(name: str, horizontal_deg: float, vertical_deg: float, tolerance: float) -> None:
    assert _compute_fields_of_view_deg(name) == pytest.approx((horizontal_deg, vertical_deg), abs=tolerance)


def test_helicopter_camera_has_lens_distortion() -> None:
    """At the corners, 400 px from the centre, the distortion is 1.8 %."""
    camera = preset("xc-55").cameras()[0]
    assert isinstance(camera, Cahvor)
    ideal = Cahv.from_focal_length(
        focal_m=6e-3, pixel_pitch_m=7.4e-6, size=(640, 480), centre=camera.c, axis=camera.a, right=camera.right
    )
    corner = np.array([[639.5, 479.5]]) - 0.5
    point = 10.0 * ideal.rays(corner)[1]
    (distorted_pixel,), _ = camera.project(point)
    distortion_px = np.linalg.norm(corner[0] - [319.5, 239.5]) - np.linalg.norm(distorted_pixel - [319.5, 239.5])
    assert distortion_px == pytest.approx(0.018 * 400.0, abs=0.3)


@pytest.mark.parametrize(
    ("name", "baseline_m"),
    [("mer-navcam", 0.20), ("mer-hazcam", 0.10), ("research-navcam", 0.20), ("research-pancam", 0.30)],
)
def test_stereo_presets_have_the_specified_baseline(name: str, baseline_m: float) -> None:
    left, right = preset(name).cameras()
    np.testing.assert_allclose(left.c - right.c, [0.0, baseline_m, 0.0], atol=1e-12)
    for camera in (left, right):
        assert camera.theta < 0
        # Up and forward have the expected signs.
        assert camera.a[0] > 0.99
        np.testing.assert_allclose(camera.down, [0.0, 0.0, -1.0], atol=1e-12)
    # A point in front of the cameras is farther right in the left image.
    point = np.array([2.0, 0.0, 0.0])
    assert left.project(point)[0][0] > right.project(point)[0][0]


def test_pancam_has_toe_in() -> None:
    """The toe-in of 2 deg reduces the disparity at 2 m, 516 px, by 120 px."""
    left, right = preset("research-pancam").cameras()
    point = np.array([2.0, 0.0, 0.0])
    disparity = left.project(point)[0][0] - right.project(point)[0][0]
    assert disparity == pytest.approx(516.1 - 120.1, abs=1.0)


@pytest.mark.parametrize("name", PRESETS)
def test_each_preset_exposes_an_image(name: str) -> None:
    """Ground of radiance factor 0.3 fills about 60 % of full scale on axis; for the descent camera 5 to 10 %."""
    camera = preset(name)
    fall_off = natural_fall_off(camera.cameras()[0])[::8, ::8]
    parameters = camera.detector.model_copy(update={"rows_summed": 1, "transfer_row_s": 0.0, "clear_row_s": 0.0})
    detector = Detector.draw(np.ascontiguousarray(fall_off), parameters, np.random.default_rng(0))
    counts = detector.expose(0.3 * np.ones_like(fall_off), np.random.default_rng(1))
    rows, columns = counts.shape
    central_counts = counts[rows // 2 - 5 : rows // 2 + 5, columns // 2 - 5 : columns // 2 + 5]
    level = np.median(central_counts) / parameters.full_scale_dn
    if "descent" in name:
        assert 0.05 < level < 0.1
    else:
        assert level == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize("name", PRESETS)
def test_responsivity_is_proportional_to_the_sunlight(name: str) -> None:
    camera = preset(name)
    at_1_au = camera.light.responsivity_e_s(1.0)
    assert camera.detector.responsivity_e_s == pytest.approx(camera.detector.sunlight * at_1_au, rel=1e-12)
    # MER's cameras are on Mars. The others, also the field test's copy of the descent camera, are on Earth.
    assert camera.detector.sunlight == pytest.approx(
        0.444 if name in ("mer-descent-flown", "mer-navcam", "mer-hazcam") else 1.0, abs=1e-3
    )


def test_campaign_can_modify_a_preset() -> None:
    detector = _Campaign.model_validate(
        {"detector": {"preset": "mer-descent-field", "temperature_c": 23.0, "optics": {"dust_discs": 3}}}
    ).detector
    expected = preset("mer-descent-field").detector
    assert detector.responsivity_e_s == expected.responsivity_e_s
    assert detector.temperature_c == 23.0
    assert detector.optics == expected.optics.model_copy(update={"dust_discs": 3})
    assert _Campaign.model_validate({"detector": {"rows_summed": 2}}).detector.rows_summed == 2
    with pytest.raises(ValidationError, match=r"unknown camera preset 'kodak'; allowed: mer-descent-flown, "):
        _Campaign.model_validate({"detector": {"preset": "kodak"}})


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
