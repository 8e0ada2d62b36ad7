"""Timeline of a triple of the field test, for its figure in the report and the exports of `marsyard replay`."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.fieldtest.flight import field_camera
from marsyard.scenarios.fieldtest.images import sun_at
from marsyard.scenarios.fieldtest.run import FieldRun
from marsyard.scenarios.timeline import Timeline
from marsyard.scenarios.timeline_surface import surface_from_above
from marsyard.scenarios.velocity_timeline import STEP_S, VelocityCase
from marsyard.scenarios.views import SiteGround, Viewpoint, site_scene
from marsyard.sim.dynamics import State
from marsyard.sim.render import Scene

#: Half width of the shown ground divided by the altitude, beyond the positions of the images.
_HALF_WIDTH_RATIO = 0.8
#: Maximum number of poses of the path.
_MAX_POSES = 2000


def triple_timeline(
    run: FieldRun,
    ground: SiteGround,
    states: Sequence[State],
    images: Sequence[UInt16[np.ndarray, "rows columns"]],
    estimate: VelocityEstimate | None,
) -> Timeline:
    """Create the timeline of a triple, from its earliest to its latest image, which may be of different passes.

    There is no estimated path: the estimated velocity refers to the virtual interval of the paper.
    """
    times_s = [state.time_s for state in states]
    start_s, end_s = min(times_s), max(times_s)
    step_s = max(STEP_S, (end_s - start_s) / _MAX_POSES)
    positions = np.stack([state.position_m for state in states])
    low, high = positions.min(axis=0), positions.max(axis=0)
    east, north = (float(value) for value in 0.5 * (low + high)[:2])
    altitude_m = float(high[2] - ground.surface.height(east, north))
    sun, field_test = sun_at(run.flown, times_s[1]), run.flown.key.field_test

    def create_scene(east_m: float, north_m: float, height_m: float, pixel_rad: float) -> Scene:
        return site_scene(ground, Viewpoint(east_m, north_m, height_m, pixel_rad), sun)

    half_width_m = 0.5 * float((high - low)[:2].max()) + _HALF_WIDTH_RATIO * altitude_m
    case = VelocityCase(
        patch=surface_from_above(create_scene, (east, north), half_width_m, field_test.backend),
        surface=ground.surface,
        motion=run.flown.flight.motion(np.append(np.arange(start_s, end_s, step_s), end_s)),
        states=states,
        images=images,
        bits=field_test.detector.bits,
        camera=field_test.detector.delivered_camera(camera_optics(field_camera()).camera),
        mounting=RigidTransform.identity(),
    )
    return case.timeline(estimate, None)
