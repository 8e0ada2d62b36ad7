"""Tests of the conformance suite for custom motions, instruments and scores: examples pass, defects are reported."""

import textwrap
from pathlib import Path

import numpy as np
import pytest

from marsyard.scenarios.conformance import parts as part_checks
from marsyard.scenarios.conformance.candidates import determine_task
from tests.scenarios.suites import run_suite, write_module

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"
#: Beginning of a module with a defective part; `poses` returns a valid descent (times, positions, quaternions).
MODULE_HEADER = """
import os
import numpy as np
from marsyard.scenarios.parts import InstrumentReadings, Poses, ScoredDescent, ScoredLanding, ScoredRun
CALLS = []
def poses(inputs, east=0.0):
    times = np.arange(inputs.from_s, 20.0, 0.1)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (times.size, 1))
    return times, np.column_stack([east * times, 0.0 * times, 2000.0 - 50.0 * times]), upright
"""


@pytest.mark.parametrize(
    ("name", "kind"),
    [("Glider", "dynamics"), ("PulsedLidar", "instrument"), ("StarTracker", "instrument"), ("lateral_impact", "score")],
)
def test_examples_of_the_documentation_conform(name: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    assert determine_task(f"custom_parts:{name}") == kind
    result = run_suite(f"custom_parts:{name}")
    assert {check: finding.problem for check, finding in result.items() if not finding.passed} == {}
    assert ("random" in result) == (kind != "score")


@pytest.mark.parametrize(
    ("check", "random", "lines", "problem"),
    [
        ("answer", False, "return poses(inputs)", "returns a tuple; allowed: marsyard.scenarios.parts.Poses"),
        ("answer", False, "t, x, q = poses(inputs)\nreturn Poses(t, x[:, :2], q)", "positions_m of shape"),
        ("answer", False, "t, x, q = poses(inputs)\nreturn Poses(t[::40], x[::40], q[::40] * 0.9)", "length 0.9"),
        (
            "answer",
            False,
            "t, x, q = poses(inputs)\nt[5] = t[4]\nreturn Poses(t, x, q)",
            "time does not increase after",
        ),
        (
            "answer",
            False,
            "t, x, q = poses(inputs)\nq[1::2] = [1.0, 0.0, 0.0, 0.0]\nreturn Poses(t, x, q)",
            "rotates by 180",
        ),
        ("answer", False, "return 1 / 0", "it raised ZeroDivisionError"),
        ("random", True, "return Poses(*poses(inputs))", "its attribute random is true, but two streams give the same"),
        ("random", False, "return Poses(*poses(inputs, rng.normal()))", "random is false, but two streams give"),
        (
            "deterministic",
            True,
            "return Poses(*poses(inputs, np.random.normal()))",
            "its answers to the same case differ between two calls",
        ),
        (
            "deterministic",
            False,
            "self.calls = getattr(self, 'calls', 0) + 1\nreturn Poses(*poses(inputs, self.calls))",
            "depends on earlier cases",
        ),
        (
            "columns",
            True,
            "return Poses(*poses(inputs), {'gust' if rng.random() > 0.4 else 'calm': 1.0})",
            "its columns change",
        ),
        ("columns", False, "return Poses(*poses(inputs), {'a b': 1.0})", "returns the invalid column name 'a b'"),
    ],
)
def test_motion_defects_are_reported(
    check: str, random: bool, lines: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = f"class Defective:\n    random = {random}\n    def fly(self, inputs, rng):\n"
    body = header + textwrap.indent(lines, " " * 8)
    name = write_module(tmp_path, monkeypatch, MODULE_HEADER + textwrap.dedent(body))
    (result,) = run_suite(f"{name}:Defective", check).values()
    assert problem in result.problem
    assert result.next_step


@pytest.mark.parametrize(
    ("check", "quantity", "lines", "problem"),
    [
        ("answer", "altitude", "return InstrumentReadings(truth.times_s[:2], np.ones(2))", "times_s of shape (2,)"),
        ("answer", "attitude", "return InstrumentReadings(truth.times_s, np.ones((truth.times_s.size, 4)))", "length"),
        (
            "answer",
            "altitude",
            "return InstrumentReadings(truth.times_s, np.full(truth.times_s.size, np.inf))",
            "infinite altitude",
        ),
        (
            "answer",
            "altitude",
            "return truth.times_s",
            "returns a ndarray; allowed: marsyard.scenarios.parts.InstrumentReadings",
        ),
        (
            "inputs",
            "altitude",
            "truth.times_s[0] -= 1.0\nreturn InstrumentReadings(truth.times_s, 1.0 * truth.times_s)",
            "it changed its input, a InstrumentTruth",
        ),
    ],
)
def test_instrument_defects_are_reported(
    check: str, quantity: str, lines: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = f"class Defective:\n    random = False\n    quantity = '{quantity}'\n    def read(self, truth, rng):\n"
    name = write_module(tmp_path, monkeypatch, MODULE_HEADER + header + textwrap.indent(lines, " " * 8))
    (result,) = run_suite(f"{name}:Defective", check).values()
    assert problem in result.problem


@pytest.mark.parametrize(
    ("check", "annotation", "lines", "problem"),
    [
        ("answer", "ScoredDescent", "return {'east': case.answer.velocity_m_s[0]}", "it raised TypeError"),
        ("answer", "ScoredLanding", "return {'site': 'here'}", "returns site of type str; allowed: a number"),
        ("columns", "ScoredRun", "return {a.state.name: 1.0 for a in case.answers}", "its columns change"),
        ("inputs", "ScoredDescent", "case.touchdown_m_s[:] = 0.0\nreturn {}", "it changed its input, a ScoredDescent"),
        (
            "deterministic",
            "ScoredRun",
            "CALLS.append(1)\nreturn {'calls': len(CALLS)}",
            "its answers to the same case differ between two calls",
        ),
    ],
)
def test_score_defects_are_reported(
    check: str, annotation: str, lines: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = f"def bad(case: {annotation}):\n" + textwrap.indent(lines, " " * 4)
    name = write_module(tmp_path, monkeypatch, MODULE_HEADER + textwrap.dedent(body))
    (result,) = run_suite(f"{name}:bad", check).values()
    assert problem in result.problem


@pytest.mark.parametrize(
    ("annotation", "kind"),
    [(": ScoredVelocity | ScoredSite | ScoredRun", "score"), (": ScoredRun", "score"), ("", "velocity")],
)
def test_annotation_identifies_a_score(
    annotation: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = "from marsyard.scenarios.parts import ScoredRun, ScoredSite, ScoredVelocity\n"
    name = write_module(tmp_path, monkeypatch, f"{header}def count(case{annotation}):\n    return {{}}\n")
    assert determine_task(f"{name}:count") == kind


def test_nearest_ground_distance_in_a_cone_matches_the_plane() -> None:
    """Independent method: intersect a grid of rays in the cone with the suite's ground, the plane z = 0.05 x."""
    apex = np.array([30.0, -20.0, 500.0])
    tilt = 0.4
    axis = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    lateral_axis, upper_axis = np.array([0.0, 1.0, 0.0]), np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    half_angle_rad = np.radians(20.0)
    off_axis, azimuth = np.meshgrid(np.linspace(0.0, half_angle_rad, 200), np.linspace(0.0, 2.0 * np.pi, 361))
    directions = (
        np.cos(off_axis)[..., None] * axis
        + (np.sin(off_axis) * np.cos(azimuth))[..., None] * upper_axis
        + (np.sin(off_axis) * np.sin(azimuth))[..., None] * lateral_axis
    )
    ranges = (apex[2] - 0.05 * apex[0]) / (0.05 * directions[..., 0] - directions[..., 2])
    # maximum range 10 km
    nearest = part_checks.instrument_cases()[0].nearest_ground(apex, axis, half_angle_rad, 1e4)
    assert nearest == pytest.approx(float(ranges.min()), rel=1e-4)
