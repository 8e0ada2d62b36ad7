"""Timeline of a descent, for its figure in the report and the exports of `marsyard replay`."""

import numpy as np

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.descent.images import camera_optics, draw_mounting
from marsyard.scenarios.descent.simulation import Descent
from marsyard.scenarios.timeline import Timeline
from marsyard.scenarios.timeline_surface import surface_from_above
from marsyard.scenarios.velocity_timeline import STEP_S, VelocityCase

#: Half width of the shown ground divided by the altitude of the first image.
_HALF_WIDTH_RATIO = 0.8


def descent_timeline(descent: Descent, estimate: VelocityEstimate | None) -> Timeline:
    """Create the timeline of a descent from its first image to the thrusters' firing."""
    p, world, states = descent.p, descent.world, descent.states
    first = states[0]
    east, north, up = (float(value) for value in first.position_m)
    half_width_m = _HALF_WIDTH_RATIO * (up - float(world.surface.height(east, north)))
    case = VelocityCase(
        patch=surface_from_above(world.scene, (east, north), half_width_m, p.render.backend),
        surface=world.surface,
        motion=descent.flight.motion.motion(np.arange(first.time_s, descent.flight.firing_s, STEP_S)),
        states=states,
        images=descent.images,
        bits=p.detector.bits,
        camera=p.detector.delivered_camera(camera_optics(p.camera).camera),
        mounting=draw_mounting(p, descent.streams),
        triple=p.triple_indices,
        increments=descent.measurements.increments,
    )
    start = None
    if estimate is not None:
        # as in `true_velocity`: tags between two images are interpolated
        tags_s = descent.measurements.tags_s
        start_tag_s = tags_s[-2] if estimate.span_s is None else estimate.span_s[0]
        start_s = float(np.interp(start_tag_s, tags_s, [state.time_s for state in states]))
        start = descent.flight.motion.state(start_s)
    return case.timeline(estimate, start)
