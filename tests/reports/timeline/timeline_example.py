"""A small timeline with each kind of content."""

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.scenarios.timeline import (
    CameraPose,
    Ellipsoids,
    InertialData,
    Path,
    Series,
    SurfacePatch,
    TimedImage,
    TimedPoints,
    Timeline,
)
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid

#: Centre of the ground, east and north.
CENTRE_M = (1000.0, 2000.0)


def make_timeline() -> Timeline:
    """Create a descent of 2 s from 100 m with two images; the simulation's clock starts at -1 s."""
    offsets = np.linspace(-50.0, 50.0, 11)
    east, north = np.meshgrid(CENTRE_M[0] + offsets, CENTRE_M[1] - offsets)
    ground = np.stack([east, north, 0.01 * (east - CENTRE_M[0])], axis=-1).astype(np.float32)
    ground[0, 0] = np.nan  # a point that is not visible
    grey = np.arange(121, dtype=np.uint8).reshape(11, 11)
    times = np.array([-1.0, 0.0, 1.0])
    positions = np.array([[*CENTRE_M, height] for height in (100.0, 90.0, 80.0)])
    level = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    return Timeline(
        surfaces={
            "ground": SurfacePatch(ground, grey),
            "map": SurfacePatch(ground[1:4, 1:4], np.full((3, 3, 3), 200, dtype=np.uint8)),
        },
        paths={"true": Path(times, positions, level), "estimated": Path(times[1:], positions[1:] + 1.0, level[1:])},
        images=[make_image(float(time), float(height)) for time, height in ((0.0, 90.0), (1.0, 80.0))],
        points={
            "touchdown": TimedPoints(np.array([1.0]), positions[2:]),
            "target": TimedPoints.permanent(np.array([*CENTRE_M, 0.0])),
        },
        ellipsoids={
            "estimated position": Ellipsoids(times[1:], positions[1:], np.tile(np.diag([4.0, 1.0, 9.0]), (2, 1, 1)))
        },
        series={
            "altitude, m": Series(times, positions[:, 2]),
            "error, m/s": Series(times, np.array([np.nan, 0.1, 0.2])),
        },
        inertial=InertialData(times, np.full((3, 3), 0.1), np.tile([0.0, 0.0, 3.7], (3, 1))),
    )


def make_camera() -> Cahv:
    """Create a camera that looks along -z of the body, with 40 x 30 pixels."""
    return Cahv.from_field_of_view(1.0, (40, 30), axis=np.array([0.0, 0.0, -1.0]), right=np.array([1.0, 0.0, 0.0]))


def make_image(time_s: float, height_m: float) -> TimedImage:
    """Create an image taken straight down above the centre."""
    counts = (np.arange(1200, dtype=np.uint16) + 256).reshape(30, 40)
    pose = CameraPose.from_camera(make_camera(), rigid(Rotation.identity(), np.array([*CENTRE_M, height_m])))
    marks = {"tracks": np.array([[10.0, 12.0], [np.nan, np.nan]])}
    return TimedImage("descent camera", time_s, counts, 12, pose, marks, {"template": np.array([[5.0, 6.0, 8.0, 9.0]])})
