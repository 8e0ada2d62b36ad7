"""Tests that exported and ingested camera files name the frame of their vectors in the first line."""

from __future__ import annotations

from pathlib import Path

from marsyard.algorithms.exchange.files import write_case
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.measured.store import write_camera
from marsyard.sim.camera import BODY_FRAME, read_cahvor


def test_exported_and_ingested_cameras_name_the_body_frame(tmp_path: Path) -> None:
    measurements = inputs.descent()
    write_case(tmp_path, measurements)
    write_camera(tmp_path, 0, measurements.images[0].camera)
    exported_file, ingested_file = tmp_path / "camera_1.cahvor", tmp_path / "cameras" / "000000.cahvor"
    for path in (exported_file, ingested_file):
        assert path.read_text().startswith(f"# Frame: {BODY_FRAME}\n")
        assert read_cahvor(path) == measurements.images[0].camera
