"""Read a camera calibration of OpenCV, ROS or Kalibr: error of its conversion, use in a campaign, projection."""

import tempfile
from pathlib import Path

import numpy as np

import marsyard
from marsyard.sim.camera import read_calibrations

# the first camera of the EuRoC data set, in Kalibr's format
CALIBRATION_FILE = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
"""
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "camchain.yaml"
    path.write_text(CALIBRATION_FILE)
    (calibration,) = read_calibrations(path)
    residual = calibration.residual
    print(f"{type(calibration.camera).__name__}: {residual.rms_px:.2f} px off (RMS), maximum {residual.max_px:.2f} px")

    # the campaign key is camera.model; DIMES bins whole pixels, so the binned size must divide the image size
    changes = {"camera.model": str(path), "detector.rows_summed": 1, "dimes.binned_size": [376, 240]}
    campaign = marsyard.load_campaign("dimes-smoke", changes)
    print("columns:", campaign.definition.parameters["camera"]["model"]["columns"])

# project a point, m, in the frame of the calibration: x right, y down, z forward
pixel, is_visible = calibration.camera.project(np.array([0.2, -0.1, 1.0]))
print("pixel:", pixel.round(2), "visible:", bool(is_visible))
