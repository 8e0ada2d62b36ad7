"""Tests of custom mast cameras: a stereo pair from calibration files, a detector from its datasheet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from marsyard.scenarios.rover.parameters import CameraParameters, RoverScenarioParameters
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.sim.camera import write_cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.sensor import preset, stereo_mast
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

OPENCV_CALIBRATION = (
    "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [640, 0, 321, 0, 640, 238, 0, 0, 1]}\n"
    "distortion_coefficients: {data: [-0.1, 0.02, 0, 0]}\n"
)
#: Datasheet of a machine vision sensor, specified for sunlight on Earth.
SENSOR_DATASHEET = (
    "pixel_pitch_um = 4.8\nfull_well_e = 10000\nread_noise_e = 5\nbits = 10\nquantum_efficiency = 0.5\n"
    "dark_current_e_s = 20\ndark_temperature_c = 20\nrows = 480\nreadout_s = 0.02\nsun_au = 1.0\n"
    "[lens]\nf_number = 4\nband_nm = [450, 700]\n"
)


@pytest.mark.parametrize(
    ("name", "baseline_m", "toe_in_deg"), [("mer-navcam", 0.20, 0.0), ("research-pancam", 0.30, 1.0)]
)
def test_pair_from_preset_files_equals_the_preset(
    name: str, baseline_m: float, toe_in_deg: float, tmp_path: Path
) -> None:
    """The pose of the pair in the files does not matter: only the relative pose of the two cameras is used."""
    file_pose = rigid(Rotation.from_euler("xyz", [20.0, -50.0, 130.0], degrees=True), np.array([3.0, -8.0, 1.5]))
    for side, camera in zip(("left", "right"), preset(name).cameras(), strict=True):
        write_cahvor(camera.transform(file_pose), tmp_path / f"{side}.cahvor")
    files = {side: str(tmp_path / f"{side}.cahvor") for side in ("left", "right")}
    pair_geometry = {"baseline_m": baseline_m, "toe_in_deg": toe_in_deg}
    mast, preset_mast = (
        CameraParameters.model_validate({"preset": name, "custom": files | pair_geometry}).mast(),
        stereo_mast(name),
    )
    points = np.array([[2.0, 0.3, -0.2], [4.0, -0.5, 0.4], [30.0, 1.0, 1.0]])
    for camera, expected_camera in ((mast.left, preset_mast.left), (mast.right, preset_mast.right)):
        assert np.allclose(camera.project(points)[0], expected_camera.project(points)[0], rtol=0.0, atol=1e-4)
    assert mast.geometry is preset_mast.geometry


def test_target_is_tracked_with_a_custom_pair(tmp_path: Path) -> None:
    camera, datasheet = tmp_path / "cam0.yaml", tmp_path / "sensor.toml"
    camera.write_text(OPENCV_CALIBRATION)
    datasheet.write_text(SENSOR_DATASHEET)
    custom = {
        "preset": "research-navcam",
        "custom": {"left": str(camera), "baseline_m": 0.24},
        "detector": str(datasheet),
    }
    parameters = RoverScenarioParameters.model_validate({**SHORT_RUN, "camera": custom})
    # The campaign stores all calibration values, so the files are not necessary.
    camera.unlink()
    datasheet.unlink()
    parameters = RoverScenarioParameters.model_validate(parameters.model_dump(mode="json", round_trip=True))
    result = RoverScenario().run(parameters, Streams(1, "own pair", 0))
    row = dict(result.row)
    assert (result.outcome, row["camera"], row["navcam"]) == ("COMPLETED", str(camera), False)
    # One pixel of disparity is 8 cm of range at 3.5 m (Eq. 1 of the tracking paper). The calibration error is at most
    # half a pixel.
    assert 0.0 < float(row["position_error_m"]) < 0.06
    # The brightest counts use the 10-bit range of the detector.
    counts = result.products["stop_1_left"]
    assert 200 < np.percentile(counts, 99) <= 1023


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"custom": {"left": "none.cahvor", "baseline_m": 0.2}}, "none.cahvor"),
        (
            {"custom": {"left": "small.yaml", "right": "large.yaml", "baseline_m": 0.2}},
            "640 x 480 pixels, the right one",
        ),
        ({"detector": {"preset": "mer-descent-flown"}}, "rows_summed is 4; allowed for cameras on a mast: 1"),
    ],
)
def test_invalid_camera_pairs_are_rejected(
    settings: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.yaml").write_text(OPENCV_CALIBRATION)
    (tmp_path / "large.yaml").write_text(OPENCV_CALIBRATION.replace("640\nimage_height", "800\nimage_height"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValidationError, match=message):
        CameraParameters.model_validate(settings)
