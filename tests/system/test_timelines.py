"""Timelines of a case of each system: they agree with the images, do not change the row, and open in Rerun."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.timeline import SurfacePatch, TimedImage, Timeline
from marsyard.scenarios.timeline_recording import recording_timelines
from tests.reports.timeline.test_exports import run_rerun

pytestmark = pytest.mark.slow

#: Small campaigns of each system, and contents that its timelines have.
CAMPAIGNS = {
    "dimes-smoke": (("terrain.samples=512",), {"valid templates", "horizontal speed, m/s"}),
    "dimes-fieldtest": ((), {"valid templates", "horizontal speed, m/s"}),
    "hda-benign": (("terrain.samples=512",), {"map", "reported site", "touchdown", "height, m"}),
    "vtt-checkout-2": (
        ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5"), {"target", "tracked target", "range m"},
    ),
    "loc-smoke": ((), {"map", "initial position", "estimated position", "horizontal error, m"}),
}  # fmt: skip
#: Maximum size of a Rerun file, bytes.
MAX_BYTES = 60e6
#: Maximum error of a template's pixel by lens distortion and relief, pixels.
MAX_TEMPLATE_ERROR_PX = 12.0
#: Maximum distortion of the mast cameras near the target, pixels.
MAX_DISTORTION_PX = 3.0


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_timeline_of_a_case(name: str, tmp_path: Path) -> None:
    # the extra `view` is installed only for slow tests
    from marsyard.reports.timeline.rerun_file import write_rerun

    overrides, contents = CAMPAIGNS[name]
    campaign = load_campaign(name, overrides)
    parameters = campaign.parameters(0)
    for shared_input in campaign.scenario.shared_inputs(parameters):
        campaign.scenario.prepare(parameters, shared_input)
    plain = campaign.scenario.run(parameters, campaign.streams(0))
    with recording_timelines():
        recorded = campaign.scenario.run(parameters, campaign.streams(0))
    assert _compared_row(recorded) == pytest.approx(_compared_row(plain), nan_ok=True)
    timeline = Timeline.from_products(recorded.products)
    assert timeline is not None
    assert Timeline.from_products(plain.products) is None
    assert contents <= {*timeline.surfaces, *timeline.points, *timeline.ellipsoids, *timeline.series}
    assert "true" in timeline.paths
    image = timeline.images[-1]
    if "target" in timeline.points:  # a camera on a mast: the ground from above looks different
        pixels, _ = _project(timeline.points["target"].positions_m, image)
        np.testing.assert_allclose(pixels, image.marks["target"], atol=MAX_DISTORTION_PX)
    else:
        patch = timeline.surfaces["ground"]
        shifted = [_correlation(patch, image, shift) for shift in ((3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0))]
        assert _correlation(patch, image) > max(0.6, *shifted)
    path = tmp_path / "case.rrd"
    write_rerun(path, timeline, name)
    run_rerun("verify", path)
    assert "/world/surfaces/ground" in run_rerun("print", "-vv", path)
    assert path.stat().st_size <= MAX_BYTES


def test_templates_on_the_ground_are_at_their_pixels() -> None:
    """DIMES receives images 1, 3 and 5 of five. Its templates are at their pixels in spite of a wrong attitude."""
    campaign = load_campaign("dimes-smoke", ("terrain.samples=512", "approach.attitude_sd_deg=3", "images=5"))
    parameters = campaign.parameters(1)
    with recording_timelines():
        timeline = Timeline.from_products(campaign.scenario.run(parameters, campaign.streams(1)).products)
    points = timeline.points["valid templates"]
    assert len(points.times_s) >= 2
    for time_s, position_m in zip(points.times_s, points.positions_m, strict=True):
        (image,) = [item for item in timeline.images if item.time_s == time_s]
        pixels, _ = _project(position_m[None], image)
        assert np.abs(image.marks["templates"] - pixels).max(axis=1).min() < MAX_TEMPLATE_ERROR_PX
    n_marks = [sum(len(pixels) for pixels in image.marks.values()) for image in timeline.images]
    assert [count > 0 for count in n_marks[:4]] == [True, False, True, False]


def _compared_row(result: CaseResult) -> dict[str, object]:
    return {column: value for column, value in result.row.items() if "time" not in column}


def _project(points_m: np.ndarray, image: TimedImage) -> tuple[np.ndarray, np.ndarray]:
    """Project points by the pinhole camera of an image; return pixels and depths."""
    pose = image.pose
    local = Rotation.from_quat(pose.quaternion_xyzw).inv().apply(points_m - pose.position_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = local[:, :2] / local[:, 2:] * pose.focal_px + pose.centre_px
    return pixels, np.asarray(local[:, 2])


def _correlation(patch: SurfacePatch, image: TimedImage, shift_cells: tuple[float, float] = (0.0, 0.0)) -> float:
    """Correlate the ground with the middle of an image, without details finer than a cell and slow changes.

    shift_cells: displacement of the image, in cells of the ground
    """
    pixels, depth_m = _project(patch.points_m.reshape(-1, 3), image)
    size = np.array(image.counts.shape[::-1])
    cell_m = np.nanmedian(np.linalg.norm(np.diff(patch.points_m, axis=1), axis=2))
    inside = (depth_m > 0.0) & ((pixels > 0.2 * size) & (pixels < 0.8 * size)).all(axis=1)
    cell_px = np.maximum(cell_m * image.pose.focal_px / np.median(depth_m[inside]), 1.0)
    columns, rows = np.rint(pixels[inside] + cell_px * shift_cells).astype(np.int64).T

    def band_pass(brightness: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        fine, coarse = (
            cv2.GaussianBlur(brightness, (0, 0), sigmaX=factor * sigma[0], sigmaY=factor * sigma[1])
            for factor in (0.5, 15.0)
        )
        return np.asarray(fine - coarse)

    seen = band_pass(image.counts.astype(np.float32), cell_px)[rows, columns]
    ground = band_pass(patch.colours.astype(np.float32), np.ones(2)).ravel()[inside]
    return float(np.corrcoef(seen, ground)[0, 1])
