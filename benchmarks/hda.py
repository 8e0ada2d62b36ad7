"""Run times of hazard detection: stages of Table I of the landing paper, dense maps and complete cases.

The times of the paper are for a MIPS R12000 processor at 400 MHz.
"""

from functools import partial

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.timing import Measurement, core_seconds
from marsyard.algorithms.hda import ElevationMap, HdaDetails, HdaEstimator, HdaOptions, hazard_maps
from marsyard.algorithms.hda.baselines import SemiGlobalEstimator
from marsyard.algorithms.hda.estimator import expected_pixels, map_ground, match_structure, motion_from_tracks
from marsyard.algorithms.hda.hazards import map_resolution
from marsyard.algorithms.hda.scene import build_scene, undistort
from marsyard.algorithms.hda.structure import scale_factor
from marsyard.algorithms.hda.tracking import select_features, track_features
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorCalibration, DetectorImage, LandingMeasurements, PoseMeasurement

#: Sony XC-55 that looks down: focal length 6 mm, pixel pitch 7.4 um.
CAMERA = Cahv.from_focal_length(0.006, 7.4e-6, (640, 480), axis=(0.0, 0.0, -1.0), right=(0.0, -1.0, 0.0))
#: Half width of the windows of Table I of the landing paper.
WINDOW_HALF_PX = 40
#: As in the landing paper: blocks of 73 px give about 59 tracks, a grid of 20 px gives 600 points.
PAPER = HdaOptions(block_px=73, window_half_px=WINDOW_HALF_PX, grid_px=20)
#: Grid of 160 x 120 structure points.
DENSE = HdaOptions(window_half_px=WINDOW_HALF_PX, grid_px=4)
#: Size of a texture sample on the ground, metres.
TEXEL_M = 0.005


def make_measurements() -> LandingMeasurements:
    """Make two images of textured level ground from a height of 10 m with a baseline of 0.36 m."""
    values = np.random.default_rng(1).standard_normal((2400, 2400)).astype(np.float32)
    # the standard deviation of smoothed white noise is proportional to 1 / sigma, hence the first factor; the factor
    # sigma**0.5 gives coarse texture a larger weight
    texture = sum(
        sigma * ndimage.gaussian_filter(values, sigma, mode="wrap", truncate=3.0) * sigma**0.5 for sigma in (4, 12, 36)
    )
    texture = np.asarray(128.0 + 40.0 * texture / np.std(texture), dtype=np.float32)
    calibration = DetectorCalibration(np.ones((480, 640)), 0.001, 0.0, 0.0, 1, 0.0, 255)
    poses = (
        rigid(Rotation.identity(), np.array([0.0, 0.0, 10.0])),
        rigid(Rotation.from_euler("zyx", [0.3, 0.2, -0.2], degrees=True), np.array([0.1, -0.35, 10.02])),
    )
    images = [DetectorImage(_draw_image(texture, pose), float(k), CAMERA, calibration) for k, pose in enumerate(poses)]
    return LandingMeasurements(
        (images[0], images[1]),
        (PoseMeasurement(poses[0], 0.0), PoseMeasurement(poses[1], 1.0)),
        10.0,
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
    )


def _draw_image(texture: np.ndarray, pose: RigidTransform) -> np.ndarray:
    """Draw the image of textured ground at z = 0 from a body pose; the world origin is at the texture's centre."""
    camera = CAMERA.transform(pose)
    rays = camera.rays(camera.pixel_grid())[1]
    ground = camera.c[:2] - camera.c[2] * rays[..., :2] / rays[..., 2:]
    texels = (ground / TEXEL_M + 0.5 * len(texture)).astype(np.float32)
    return np.rint(np.clip(cv2.remap(texture, texels, None, cv2.INTER_LINEAR), 0, 255)).astype(np.uint16)


def measure(repeats: int) -> list[Measurement]:
    """Measure stages and total with the paper's parameters, dense estimation, a large hazard map, and a case."""
    measurements = make_measurements()
    estimators = _measure_estimators(measurements, repeats)
    return [*measure_stages(measurements, repeats), *estimators, _measure_large_map(repeats), measure_cases(repeats)]


def measure_stages(measurements: LandingMeasurements, repeats: int) -> list[Measurement]:
    """Measure the four stages of Table I of the landing paper; the scale is part of structure from motion."""
    scene = build_scene(measurements)
    details = HdaEstimator(PAPER).estimate(measurements).details
    assert isinstance(details, HdaDetails)
    tracks, motion, matches, ground = details.tracks, details.motion, details.matches, details.ground
    assert tracks is not None
    assert motion is not None
    assert matches is not None
    assert ground is not None
    first, second = (view.counts for view in scene.views)
    points = undistort(scene.views[0].camera, tracks.first[tracks.accepted])
    resolution = map_resolution(motion, scene.views[0].focal_px, PAPER)

    def track() -> None:
        features = select_features(first, PAPER)
        track_features(first, second, features, expected_pixels(scene, features, PAPER), WINDOW_HALF_PX, PAPER)

    def estimate_motion() -> None:
        scale_factor(scene.views, motion_from_tracks(scene, tracks, PAPER), points, scene.range_m, PAPER)

    rows, columns = ground.elevation.elevation_m.shape
    return [
        Measurement(
            "HDA features: 11 x 11 px templates in 81 x 81 px windows (paper: 0.21 s)", core_seconds(track, repeats)
        ),
        Measurement(
            f"HDA motion: {tracks.accepted.sum()} tracks (paper: 59 tracks, 0.10 s)",
            core_seconds(estimate_motion, repeats),
        ),
        Measurement(
            f"HDA structure: {len(matches.points)} points (paper: 600 points, 0.41 s)",
            core_seconds(lambda: match_structure(scene, motion, PAPER), repeats),
        ),
        Measurement(
            f"HDA map and hazards: {rows} x {columns} cells (paper: 19 x 27 cells, 0.05 s)",
            core_seconds(lambda: map_ground(scene, matches.points, resolution, PAPER), repeats),
        ),
    ]


def _measure_estimators(measurements: LandingMeasurements, repeats: int) -> list[Measurement]:
    """Measure all stages together: with the paper's parameters, with a dense grid, and by semi-global matching."""
    return [
        Measurement(
            "HDA, all stages with the paper's parameters (paper: 0.77 s)",
            core_seconds(lambda: HdaEstimator(PAPER).estimate(measurements), repeats),
            limit=0.03,
        ),
        Measurement(
            "HDA, all stages: 160 x 120 points of a 640 x 480 px image",
            core_seconds(lambda: HdaEstimator(DENSE).estimate(measurements), repeats),
            limit=0.2,
        ),
        Measurement(
            "HDA by semi-global matching: 160 x 120 points of a 640 x 480 px image",
            core_seconds(lambda: SemiGlobalEstimator(DENSE).estimate(measurements), repeats),
        ),
    ]


def _measure_large_map(repeats: int) -> Measurement:
    """Measure the hazard maps of rough random ground with cells of 0.1 m."""
    elevation_m = 0.02 * np.random.default_rng(1).standard_normal((256, 256))
    ground = ElevationMap(elevation_m, np.zeros(2), 0.1)
    return Measurement(
        "HDA hazard maps: 256 x 256 cells", core_seconds(lambda: hazard_maps(ground, HdaOptions()), repeats), limit=0.05
    )


def measure_cases(cases: int) -> Measurement:
    """Measure complete cases of `hda-hazardous` with prepared terrain."""
    campaign = load_campaign("hda-hazardous")

    def run_case(number: int) -> None:
        campaign.scenario.run(campaign.parameters(number), campaign.streams(number))

    times = [time for number in range(cases) for time in core_seconds(partial(run_case, number), 1)]
    return Measurement("hda-hazardous case: flight, 2 frames, map, landing, truth", times, limit=0.6)
