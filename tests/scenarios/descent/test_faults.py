"""Faults: each does what it says, by its size, and nothing when it is off."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic.fields import FieldInfo
from scipy.spatial.transform import Rotation

from marsyard.scenarios.conditions import deliver, faulty_detector
from marsyard.scenarios.descent.exposure import (
    SHIELD_DIAMETER_M,
    HeatShield,
    World,
    add_haze,
    calibrated_camera,
    camera_optics,
    take_exposures,
)
from marsyard.scenarios.descent.flight import create_flight, picture_states
from marsyard.scenarios.descent.parameters import (
    CameraParameters,
    Faults,
    faulty_altitudes,
    faulty_attitudes,
    faulty_terrain,
    faulty_times,
)
from marsyard.sim.dynamics import State
from marsyard.sim.frames import direction, rigid
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement
from marsyard.sim.render import Frame, PixelRays, Sun
from marsyard.sim.sensor import Detector, DetectorParameters
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Environment, TerrainParameters
from tests.scenarios.descent.settings import NOISELESS, parameters, run

SMALL = CameraParameters(columns=256, rows=256, pixel_pitch_um=48.0)
SUN = Sun(direction(4.0, 0.7))


def _frame(height_m: float, radiance: np.ndarray) -> Frame:
    """What a small camera that looks straight down sees of level ground."""
    rays = PixelRays.of(camera_optics(SMALL).camera)
    down = -rays.directions[:, 2].astype(np.float64)
    return Frame(
        radiance=radiance.astype(np.float32),
        range_m=(height_m / down).reshape(256, 256),
        body=np.full((256, 256), -1, dtype=np.int32),
        normal=np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (256, 256, 1)),
        world_from_body=rigid(Rotation.identity(), np.array([0.0, 0.0, height_m])),
        rays=rays,
    )


def _state(height_m: float) -> State:
    still = np.zeros(3)
    return State(0.0, np.array([0.0, 0.0, height_m]), still, Rotation.identity(), still, still)


def test_no_fault_changes_nothing() -> None:
    none = Faults()
    terrain, detector = TerrainParameters(), DetectorParameters()
    assert faulty_terrain(none, terrain) == terrain
    assert faulty_detector(none, detector) == detector
    assert faulty_times(none, [0.0, 3.75, 7.5]) == [0.0, 3.75, 7.5]
    assert none.columns == {"fault": "none", "fault_size": 0.0}


@pytest.mark.parametrize(("name", "field"), Faults.model_fields.items())
def test_a_fault_is_named_with_its_size(name: str, field: FieldInfo) -> None:
    size = 2 if field.annotation is int else 0.25
    assert Faults.model_validate({name: size}).columns == {"fault": name, "fault_size": size}


def test_several_faults_have_no_size() -> None:
    name, size = Faults(haze=1.0, dust_discs=3).columns.values()
    assert name == "several"
    assert np.isnan(size)


def test_haze_takes_contrast_and_leaves_light() -> None:
    """From straight above contrast falls as exp(-depth); the veil is neither black nor glaring."""
    pattern = np.where(np.indices((256, 256)).sum(axis=0) % 2, 0.12, 0.10)
    frame = _frame(2000.0, pattern)
    clear, hazy = add_haze(frame, 0.0, SUN, Environment()), add_haze(frame, 1.0, SUN, Environment())
    np.testing.assert_allclose(clear, pattern, rtol=1e-6)
    middle = np.s_[126:130, 126:130]
    assert np.ptp(hazy[middle]) == pytest.approx(np.exp(-1.0) * 0.02, rel=0.03)
    assert 0.5 < hazy.mean() / pattern.mean() < 2.0


@pytest.mark.parametrize("angle_deg", [1.0, 4.0])
def test_the_heat_shield_is_as_large_as_asked_for(angle_deg: float) -> None:
    """Seen face on its disc takes pi / 4 of its angle squared."""
    frame = _frame(2000.0, np.full((256, 256), 0.5))
    first = _state(2000.0)
    drawn = HeatShield.draw(first, np.radians(angle_deg), np.random.default_rng(3))
    towards = drawn.centre_m - first.position_m
    faced = replace(drawn, normal=towards / np.linalg.norm(towards), spin_rad_s=np.zeros(3))
    seen = faced.draw_over(frame.radiance, frame, SUN, 0.0)
    solid = frame.rays.pixel_angles.astype(np.float64) ** 2
    covered = solid[(seen != frame.radiance).reshape(-1)].sum()
    assert covered == pytest.approx(np.pi / 4.0 * np.radians(angle_deg) ** 2, rel=0.1)
    # 20 m/s away for 3.75 s
    later = faced.draw_over(frame.radiance, frame, SUN, 3.75)
    distance = SHIELD_DIAMETER_M / np.radians(angle_deg)
    shrunk = solid[(later != frame.radiance).reshape(-1)].sum() / covered
    assert shrunk == pytest.approx((distance / (distance + 75.0)) ** 2, abs=0.05)


def test_pictures_may_come_twice_or_black() -> None:
    pictures = [np.full((4, 4), value, dtype=np.uint16) for value in (1, 2, 3)]
    assert [int(one[0, 0]) for one in deliver(pictures, 3, 0)] == [1, 2, 2]
    assert [int(one[0, 0]) for one in deliver(pictures, 0, 1)] == [0, 2, 3]
    assert [int(one[0, 0]) for one in pictures] == [1, 2, 3]


def test_readings_are_wrong_by_what_is_asked_for() -> None:
    faults = Faults(altitude_error=0.1, altitude_error_once=0.2, attitude_error_deg=3.0, attitude_error_once_deg=5.0)
    altitudes = faulty_altitudes(faults, [AltitudeMeasurement(100.0, t) for t in (0.0, 1.0, 2.0)])
    assert [one.altitude_m for one in altitudes] == pytest.approx([110.0, 130.0, 110.0])
    level = [AttitudeMeasurement(Rotation.identity(), t) for t in (0.0, 1.0, 2.0)]
    tilted = [one.world_from_body for one in faulty_attitudes(faults, level, np.random.default_rng(0))]
    assert np.degrees([one.magnitude() for one in (tilted[0], tilted[2])]) == pytest.approx([3.0, 3.0])
    assert np.degrees((tilted[1] * tilted[0].inv()).magnitude()) == pytest.approx(5.0)
    assert tilted[0].as_rotvec()[2] == 0.0


def _pictures(faults: Mapping[str, Any], **parts: Any) -> list[np.ndarray]:
    p = parameters(faults=faults, detector=NOISELESS, **parts)
    world, streams = World.of(p), Streams(1, "faults", 0)
    states = picture_states(p, create_flight(p, world.surface, streams))
    optics = camera_optics(p.camera)
    detector = Detector.drawn(optics.fall_off, faulty_detector(p.faults, p.detector), streams.generator("detector"))
    return [counts for counts, _ in take_exposures(p, world, states, optics, detector, streams)]


def test_faults_show_in_pictures() -> None:
    """Each in its own way: a share of the pixels changed in all pictures, or all in one."""
    clear = _pictures({})

    def changed(faults: Mapping[str, Any]) -> list[float]:
        return [float(np.mean(np.abs(a / b - 1.0) > 0.02)) for a, b in zip(_pictures(faults), clear, strict=True)]

    dust = changed({"dust_discs": 10})
    assert all(0.002 < share < 0.3 for share in dust)
    assert np.ptp(dust) < 0.02
    # one of the four rows summed into a pixel is enough
    assert changed({"bad_pixels": 0.01})[0] > 0.02
    late = changed({"late_s": 0.5})
    assert late[0] == late[2] == 0.0 < late[1]
    shield = changed({"heat_shield_deg": 5.0})
    # the clouds' shadows, and what of the picture is brighter for their light
    assert min(changed({"cloud_cover": 0.4})) > 0.2
    # edge on it may hide in one of them, as it tumbles
    assert max(shield) > 0.001


def test_calibration_is_off_by_what_is_asked_for() -> None:
    """Over many draws, of the focal length and centre, and of where a corner lies."""
    p = CameraParameters()
    true = camera_optics(p).camera
    drawn = [calibrated_camera(p, np.random.default_rng(seed)) for seed in range(300)]
    ahead = np.array([[0.0, 0.0, -1.0]])
    centres = np.stack([one.project(ahead)[0][0] for one in drawn]) - true.project(ahead)[0][0]
    # 300 draws tell a standard deviation to 4 %
    assert centres.std(axis=0) == pytest.approx([p.centre_error_px] * 2, rel=0.15)
    _, towards = true.rays(np.array([[0.0, 0.0]]))
    moved = np.stack([one.project(towards)[0][0] for one in drawn]) - centres - true.project(towards)[0][0]
    outwards = moved @ np.array([-1.0, -1.0]) / np.sqrt(2.0)
    expected = np.hypot(p.distortion_error_px, p.focal_error * np.hypot(511.5, 511.5))
    assert outwards.std() == pytest.approx(expected, rel=0.15)
    assert np.abs(moved @ np.array([1.0, -1.0])).max() < 0.02


def test_regular_dunes_confuse_the_second_peak() -> None:
    """The paper's ratio of peaks is there for repetitive terrain."""
    result = run(faults={"dunes_m": 4.0}, descent={"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "wind_east_m_s": 10.0})
    columns = list(result.products["tracks_columns"])
    ratios = result.products["tracks"][:, columns.index("second_peak_ratio")]
    assert ratios.max() > 0.6
    assert result.outcome != "VALID" or float(result.row["velocity_error_m_s"]) < 5.0
