"""Tests of the descent scenario with user-defined (custom) motions, instruments and scores."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.descent.flight import create_flight
from marsyard.scenarios.descent.measurements import DescentInstruments
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.parts import InstrumentReadings, InstrumentTruth, MotionInputs, Poses, ScoredDescent
from marsyard.scenarios.parts.scores import compute_scores
from marsyard.sim.streams import Streams
from tests.scenarios.descent.descents import FLAT_TERRAIN, IDEAL_INSTRUMENTS, make_parameters, run_descent

MODULE = f"{__name__}:"


@dataclass(frozen=True)
class RotatingDescent:
    """Custom motion: constant velocity and rotation about the vertical; `defect` selects an invalid output."""

    random: ClassVar[bool] = True

    height_m: float = 2000.0
    east_m_s: float = 11.0
    duration_s: float = 26.0
    defect: str = ""

    def fly(self, inputs: MotionInputs, rng: np.random.Generator) -> Poses:
        north = float(rng.normal(0.0, 5.0))
        times = np.arange(inputs.from_s, self.duration_s, 0.05)
        if self.defect == "short":
            times = np.arange(inputs.from_s, 3.0, 0.1)
        positions = np.column_stack([self.east_m_s * times, north * times, self.height_m - 75.0 * times])
        quaternions = Rotation.from_rotvec(np.outer(0.1 * times, [0.0, 0.0, 1.0])).as_quat()
        if self.defect == "length":
            quaternions *= 1.1
        if self.defect == "up":
            quaternions = (Rotation.from_euler("x", np.pi) * Rotation.from_quat(quaternions)).as_quat()
        if self.defect == "order":
            times = times[::-1]
        if self.defect == "nan":
            positions[7, 1] = np.nan
        columns = {"height_m": 1.0} if self.defect == "column" else {"north_m_s": north}
        return Poses(times, positions, quaternions, columns)


@dataclass(frozen=True)
class OffsetAltimeter:
    """Custom altimeter with a constant error."""

    quantity: ClassVar[str] = "altitude"
    random: ClassVar[bool] = False

    bias_m: float = 0.0

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        heights = np.array([truth.altitude_m(time) for time in truth.times_s])
        return InstrumentReadings(truth.times_s, heights + self.bias_m, {"applied_m": self.bias_m})


@dataclass(frozen=True)
class RotatedAttitude:
    """Custom attitude source: true attitudes rotated about the vertical."""

    quantity: ClassVar[str] = "attitude"
    random: ClassVar[bool] = False

    yaw_error_deg: float = 0.3

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        rotation = Rotation.from_euler("z", self.yaw_error_deg, degrees=True)
        attitudes = (rotation * truth.motion.motion(truth.times_s).attitudes).as_quat()
        times = truth.times_s.copy()
        truth.times_s[:] = -1.0  # by mistake; the images keep their time tags
        return InstrumentReadings(times, attitudes)


def record_inputs(case: ScoredDescent) -> dict[str, float | bool]:
    """Return the inputs of the score for comparison with the row."""
    estimated_velocity = case.answer.velocity_m_s
    first, second = case.states[1:3]
    true_velocity = (second.position_m - first.position_m)[:2] / (second.time_s - first.time_s)
    return {
        "altitude_m": case.measurements.altitudes[1].altitude_m,
        "error_m_s": np.nan if estimated_velocity is None else float(np.hypot(*(estimated_velocity - true_velocity))),
        "touchdown_m_s": float(np.hypot(*case.touchdown_m_s)),
        "firing_s": case.at_firing.time_s,
        "at_firing": bool(np.allclose(case.motion.state(case.at_firing.time_s).position_m, case.at_firing.position_m)),
    }


def return_existing_column(case: ScoredDescent) -> dict[str, float]:
    """Return a column whose full name (function name and key) exists in the row: `velocity_error_m_s`."""
    return {"m_s": 1.0}


def change_truth(case: ScoredDescent) -> dict[str, float]:
    """Change the true velocity, which later scores and algorithms would receive."""
    case.states[-1].velocity_m_s[:] = 0.0
    return {"m_s": 1.0}


# the name under which the campaign lists the score
velocity_error = return_existing_column

CUSTOM_PARTS: dict[str, Any] = {
    "flight": {"motion": f"{MODULE}RotatingDescent", "attitude_of": "body"},
    "altimeter": {"instrument": f"{MODULE}OffsetAltimeter", "options": {"bias_m": 6.0}},
    "attitude_source": {"instrument": f"{MODULE}RotatedAttitude"},
    "scores": [f"{MODULE}record_inputs"],
}


def test_case_uses_custom_motion_instruments_and_score() -> None:
    ideal_instruments = {name: part for name, part in IDEAL_INSTRUMENTS.items() if name != "altimeter"}
    result = run_descent(terrain=FLAT_TERRAIN, **ideal_instruments, **CUSTOM_PARTS)
    row = result.row
    assert result.outcome == "VALID"
    # Motion: the row has the velocity of the custom flight. Firing is at 100 m above level ground: after a fall of
    # 1900 m at 75 m/s.
    assert row["velocity_true_x_m_s"] == pytest.approx(11.0, abs=1e-6)
    assert row["velocity_true_y_m_s"] == pytest.approx(row["flight_north_m_s"], abs=1e-6)
    assert row["altitude_1_m"] == pytest.approx(2000.0, abs=1e-3)
    assert row["record_inputs_firing_s"] == pytest.approx(1900.0 / 75.0, abs=1e-4)
    # Instruments: the row has their errors.
    for number in (1, 2, 3):
        assert row[f"altitude_error_{number}_m"] == pytest.approx(6.0, abs=1e-6)
        assert row[f"attitude_error_{number}_deg"] == pytest.approx(0.3, abs=1e-6)
    assert (row["altimeter_bias_m"], row["altimeter_applied_m"], row["altimeter_instrument"]) == (
        6.0,
        6.0,
        f"{MODULE}OffsetAltimeter",
    )
    assert row["attitude_source_yaw_error_deg"] == 0.3
    # The score receives the algorithm's measurements, its answer and the truth.
    assert row["record_inputs_altitude_m"] == pytest.approx(float(row["altitude_2_m"]) + 6.0, abs=1e-6)
    assert row["record_inputs_error_m_s"] == pytest.approx(row["velocity_error_m_s"], abs=1e-9)
    assert row["record_inputs_touchdown_m_s"] == row["touchdown_speed_corrected_m_s"]
    assert row["record_inputs_at_firing"] is True


def test_motion_is_deterministic_per_case() -> None:
    parameters = make_parameters(terrain=FLAT_TERRAIN, **CUSTOM_PARTS)
    surface = DescentWorld.from_parameters(parameters).surface
    first_row, repeated_row, second_row = (
        create_flight(parameters, surface, Streams(1, "test", case)).row for case in (0, 0, 1)
    )
    assert first_row == repeated_row
    assert first_row["flight_north_m_s"] != second_row["flight_north_m_s"]
    assert not any(name.startswith("descent_") for name in first_row)


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("short", "covers -5 to 2.9 s; allowed: from at most -5 s to at least 8 s"),
        ("length", r"returns a quaternion of length 1\.1 \(pose 1\); allowed: 1"),
        ("up", "at image 1 the camera looks up"),
        ("order", "covers 25.95 to -5 s"),
        ("nan", "returns positions_m that are not finite"),
        ("column", "reports the column height_m, which is also the name of an option"),
    ],
)
def test_invalid_motion_is_reported(defect: str, message: str) -> None:
    flight = {**CUSTOM_PARTS["flight"], "options": {"defect": defect}}
    parameters = make_parameters(terrain=FLAT_TERRAIN, flight=flight)
    with pytest.raises(ValueError, match=message):
        create_flight(parameters, DescentWorld.from_parameters(parameters).surface, Streams(1, "test", 0))


@pytest.mark.parametrize("duration_s", [20.0, 20.05, 27.95, 28.0])
def test_firing_is_at_the_end_of_a_short_motion(duration_s: float) -> None:
    """If the motion ends above the firing altitude, the firing is 0.1 s before its end, for any rounding of times."""
    flight = {**CUSTOM_PARTS["flight"], "options": {"east_m_s": 0.0, "duration_s": duration_s, "height_m": 5000.0}}
    parameters = make_parameters(terrain=FLAT_TERRAIN, flight=flight)
    world, streams = DescentWorld.from_parameters(parameters), Streams(1, "test", 0)
    created_flight = create_flight(parameters, world.surface, streams)
    assert created_flight.firing_s == pytest.approx(created_flight.motion.span_s[1] - 0.1)
    navigation = DescentInstruments.draw(parameters, world, created_flight, streams).navigation
    assert navigation.velocity(np.array([created_flight.firing_s])).shape == (1, 3)


def test_motion_below_the_ground_is_reported() -> None:
    flight = {**CUSTOM_PARTS["flight"], "options": {"height_m": 500.0}}
    parameters = make_parameters(terrain=FLAT_TERRAIN, flight=flight)
    with pytest.raises(ValueError, match=r"at image 3 the camera is 62\.5 m below the ground"):
        create_flight(parameters, DescentWorld.from_parameters(parameters).surface, Streams(1, "test", 0))


def test_score_cannot_replace_a_column() -> None:
    spec = f"{MODULE}velocity_error"
    with pytest.raises(ValueError, match="returns the column velocity_error_m_s, which the row already contains"):
        compute_scores([spec], None, {"velocity_error_m_s"})  # type: ignore[arg-type]


def test_score_cannot_change_the_truth() -> None:
    message = r"change_truth' changed its case; allowed: reading it, and changing copies"
    with pytest.raises(ValueError, match=message):
        run_descent(terrain=FLAT_TERRAIN, scores=[f"{MODULE}change_truth", f"{MODULE}record_inputs"])
