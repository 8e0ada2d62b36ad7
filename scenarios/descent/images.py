"""Images of a descent: camera and its mounting, haze, a falling heat shield in view, and the detector."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import Optics, draw_calibrated
from marsyard.scenarios.cameras import camera_optics as shared_optics
from marsyard.scenarios.case_faults import HAZE_PATH_M
from marsyard.scenarios.descent.faults import draw_clouds
from marsyard.scenarios.descent.parameters import DescentCameraParameters, DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.heat_shield import HeatShield
from marsyard.scenarios.radiance import add_haze
from marsyard.scenarios.views import render_state
from marsyard.sim.camera import Cahv, Cahvor, CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams


def take_exposures(
    p: DescentScenarioParameters,
    world: DescentWorld,
    states: Sequence[State],
    optics: Optics,
    detector: Detector,
    streams: Streams,
) -> Iterator[tuple[UInt16[np.ndarray, "rows columns"], Frame]]:
    """Render and expose the images; yield detector counts and the frame, with haze, of each image.

    Faults of the transmission (repeated or black images) are added later.
    """
    surface = world.surface
    east_m, north_m, _ = states[0].position_m.tolist()
    last_east_m, last_north_m, last_up_m = states[-1].position_m.tolist()
    last_height_m = last_up_m - float(surface.height(last_east_m, last_north_m))
    scene = world.scene(east_m, north_m, last_height_m, optics.rays.pixel_rad)
    clouds = draw_clouds(p.faults, float(surface.height(east_m, north_m)), streams.generator("clouds"))
    # a disc at the camera casts the vehicle's shadow
    scene = replace(scene, caster_diameter_m=p.lander.caster_diameter_m, clouds=clouds)
    mounting, shield = draw_mounting(p, streams), None
    if p.faults.heat_shield_deg:
        angle = float(np.radians(p.faults.heat_shield_deg))
        shield = HeatShield.draw(states[0], angle, streams.generator("heat shield"))
    noise = streams.generator("detector noise")
    for state in states:
        frame, motion = render_state(p.render.backend, scene, optics, state, mounting)
        height = float(state.position_m[2]) - float(surface.height(*state.position_m[:2]))
        extinction = world.air.mean_extinction_m(height) if world.ground else 0.0
        haze = extinction + p.faults.haze / HAZE_PATH_M
        frame = replace(frame, radiance=add_haze(frame, world.air, world.sun, haze))
        if shield is not None:
            frame = shield.paint_over(frame, world.sun, state.time_s)
        yield detector.expose(frame.radiance * np.float32(world.brightness), noise, motion), frame


def draw_mounting(p: DescentScenarioParameters, streams: Streams) -> RigidTransform:
    """Draw the camera's pose in the body: at its origin, rotated by an alignment error unknown to the lander."""
    alignment_deg = 0.0 if p.exact_instruments else p.camera.alignment_error_deg
    tilt = np.radians(alignment_deg) * streams.generator("camera alignment").standard_normal(3)
    return RigidTransform.from_rotation(Rotation.from_rotvec(tilt))


def camera_optics(parameters: DescentCameraParameters) -> Optics:
    """Create the true camera in the body frame: at the origin, looking down; columns point east at zero attitude."""
    model = parameters.model
    return shared_optics(_create_camera(parameters, 1.0, (0.0, 0.0), 0.0) if model is None else model.camera())


def calibrated_camera(parameters: DescentCameraParameters, rng: np.random.Generator) -> CameraModel:
    """Return the calibrated camera: the true camera of `camera_optics` with sampled calibration errors."""
    p = parameters
    if p.model is not None:
        return draw_calibrated(p.model.camera(), p, rng)
    focal, column, row, distortion = rng.standard_normal(4)
    centre = (p.centre_error_px * float(column), p.centre_error_px * float(row))
    return _create_camera(p, 1.0 + p.focal_error * focal, centre, p.distortion_error_px * distortion)


def _create_camera(
    p: DescentCameraParameters, focal_factor: float, shift_px: tuple[float, float], corner_px: float
) -> Cahvor:
    """Create the camera with scaled focal length, shifted image centre, and corners distorted outwards by corner_px."""
    centre = (0.5 * (p.columns - 1), 0.5 * (p.rows - 1))
    focal_px = p.focal_length_mm / (1e-3 * p.pixel_pitch_um)
    pinhole = Cahv.from_axes(
        (focal_factor * focal_px, focal_factor * focal_px),
        (p.columns, p.rows),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
        image_centre=(centre[0] + shift_px[0], centre[1] + shift_px[1]),
    )
    # CAHVOR moves a point at angle a from the axis outwards by the fraction R0 + R1 tan(a)^2 + ... of its distance;
    # at a corner, tan(a) = radius_px / focal_px
    radius_px = float(np.hypot(*centre))
    radial_1 = p.radial_1 + corner_px / radius_px / (radius_px / focal_px) ** 2
    return Cahvor.from_cahv(pinhole, r=np.array([p.radial_0, radial_1, p.radial_2]))
