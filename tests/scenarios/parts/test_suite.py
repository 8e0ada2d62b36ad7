"""Tests of the conformance suite for custom motions, instruments and scores: examples pass, defects are reported."""

import textwrap
from pathlib import Path

import numpy as np
import pytest

from marsyard.scenarios.conformance import parts as part_checks
from marsyard.scenarios.conformance.candidates import determine_task
from tests.scenarios.suites import run_suite, write_module

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"
DIFFERENT_ANSWERS = "answers to the same case differ between two calls"
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


def format_part(kind: str, lines: str) -> str:
    """Return the source of a part `Defective` with these lines.

    kind: motion or random motion, quantity of an instrument, or type of a score's case
    """
    if kind.startswith("Scored"):
        return f"def Defective(case: {kind}):\n" + textwrap.indent(lines, " " * 4)
    if kind.endswith("motion"):
        members = f"random = {kind != 'motion'}\ndef fly(self, inputs, rng):\n"
    else:
        members = f"random = False\nquantity = '{kind}'\ndef read(self, truth, rng):\n"
    return "class Defective:\n" + textwrap.indent(members + textwrap.indent(lines, " " * 4), " " * 4)


#: Kind of a part, its lines, the check that finds its defect, and a part of the message.
DEFECTS = [
    ("motion", "return poses(inputs)", "answer", "returns a tuple; allowed: marsyard.scenarios.parts.Poses"),
    ("motion", "t, x, q = poses(inputs)\nreturn Poses(t, x[:, :2], q)", "answer", "positions_m of shape"),
    ("motion", "t, x, q = poses(inputs)\nreturn Poses(t[::40], x[::40], q[::40] * 0.9)", "answer", "length 0.9"),
    ("motion", "t, x, q = poses(inputs)\nt[5] = t[4]\nreturn Poses(t, x, q)", "answer", "time does not increase after"),
    ("motion", "t, x, q = poses(inputs)\nq[1::2] = [1, 0, 0, 0]\nreturn Poses(t, x, q)", "answer", "rotates by 180"),
    ("motion", "return 1 / 0", "answer", "it raised ZeroDivisionError"),
    ("random motion", "return Poses(*poses(inputs))", "random", "random is true, but two streams give the same"),
    ("motion", "return Poses(*poses(inputs, rng.normal()))", "random", "random is false, but two streams give"),
    ("random motion", "return Poses(*poses(inputs, np.random.normal()))", "deterministic", f"its {DIFFERENT_ANSWERS}"),
    (
        "motion",
        "self.calls = getattr(self, 'calls', 0) + 1\nreturn Poses(*poses(inputs, self.calls))",
        "deterministic",
        "depends on earlier cases",
    ),
    (
        "random motion",
        "return Poses(*poses(inputs), {'gust' if rng.random() > 0.4 else 'calm': 1.0})",
        "columns",
        "its columns change",
    ),
    ("motion", "return Poses(*poses(inputs), {'a b': 1.0})", "columns", "returns the invalid column name 'a b'"),
    ("altitude", "return InstrumentReadings(truth.times_s[:2], np.ones(2))", "answer", "times_s of shape (2,)"),
    ("attitude", "return InstrumentReadings(truth.times_s, np.ones((truth.times_s.size, 4)))", "answer", "length"),
    (
        "altitude",
        "return InstrumentReadings(truth.times_s, np.full(truth.times_s.size, np.inf))",
        "answer",
        "infinite altitude",
    ),
    ("altitude", "return truth.times_s", "answer", "a ndarray; allowed: marsyard.scenarios.parts.InstrumentReadings"),
    (
        "altitude",
        "truth.times_s[0] -= 1.0\nreturn InstrumentReadings(truth.times_s, 1.0 * truth.times_s)",
        "inputs",
        "it changed its input, a InstrumentTruth",
    ),
    ("ScoredDescent", "return {'east': case.answer.velocity_m_s[0]}", "answer", "it raised TypeError"),
    ("ScoredLanding", "return {'site': 'here'}", "answer", "returns site of type str; allowed: a number"),
    ("ScoredRun", "return {a.state.name: 1.0 for a in case.answers}", "columns", "its columns change"),
    ("ScoredDescent", "case.touchdown_m_s[:] = 0.0\nreturn {}", "inputs", "it changed its input, a ScoredDescent"),
    ("ScoredRun", "CALLS.append(1)\nreturn {'calls': len(CALLS)}", "deterministic", f"its {DIFFERENT_ANSWERS}"),
]


@pytest.mark.parametrize(("kind", "lines", "check", "problem"), DEFECTS)
def test_defects_are_reported(
    kind: str, lines: str, check: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = write_module(tmp_path, monkeypatch, MODULE_HEADER + format_part(kind, lines))
    (result,) = run_suite(f"{name}:Defective", check).values()
    assert problem in result.problem
    assert result.next_step


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
