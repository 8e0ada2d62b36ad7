"""Tests of the conformance suite for parts: the examples pass, and defects are reported."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
import pytest

from marsyard.scenarios.conformance import Finding, Subject, check_names, determine_task, run_check
from marsyard.scenarios.conformance import parts as suite

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"
HEAD = """
import os
import numpy as np
from marsyard.scenarios.parts import InstrumentReadings, Poses, ScoredDescent, ScoredLanding, ScoredRun
KEPT = []
def poses(place, east=0.0):
    times = np.arange(place.from_s, 20.0, 0.1)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (times.size, 1))
    return times, np.column_stack([east * times, 0.0 * times, 2000.0 - 50.0 * times]), upright
"""


def run_suite(spec: str, *only: str) -> dict[str, Finding]:
    subject = Subject(spec, determine_task(spec), 60.0)
    names = [name for name, _ in check_names(subject)]
    return {name: run_check(subject, names.index(name)) for name in (only or names)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [("Glider", "dynamics"), ("PulsedLidar", "instrument"), ("StarTracker", "instrument"), ("sideways", "score")],
)
def test_the_examples_conform(name: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    assert determine_task(f"custom_parts:{name}") == kind
    result = run_suite(f"custom_parts:{name}")
    assert {check: one.problem for check, one in result.items() if not one.passed} == {}
    assert ("random" in result) == (kind != "score")


def write_bad_part(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> str:
    """Write a module with a unique name, as Python caches modules."""
    name = f"bad_part_{abs(hash(body))}"
    (folder / f"{name}.py").write_text(HEAD + textwrap.dedent(body))
    monkeypatch.syspath_prepend(str(folder))
    return name


@pytest.mark.parametrize(
    ("check", "random", "lines", "problem"),
    [
        ("answer", False, "return poses(place)", "returns a tuple; allowed: marsyard.scenarios.parts.Poses"),
        ("answer", False, "t, x, q = poses(place)\nreturn Poses(t, x[:, :2], q)", "positions_m of shape"),
        ("answer", False, "t, x, q = poses(place)\nreturn Poses(t[::40], x[::40], q[::40] * 0.9)", "length 0.9"),
        ("answer", False, "t, x, q = poses(place)\nt[5] = t[4]\nreturn Poses(t, x, q)", "time does not increase after"),
        (
            "answer",
            False,
            "t, x, q = poses(place)\nq[1::2] = [1.0, 0.0, 0.0, 0.0]\nreturn Poses(t, x, q)",
            "turns by 180",
        ),
        ("answer", False, "return 1 / 0", "it raised ZeroDivisionError"),
        ("random", True, "return Poses(*poses(place))", "its attribute random is true, but two streams give the same"),
        ("random", False, "return Poses(*poses(place, rng.normal()))", "random is false, but two streams give"),
        (
            "deterministic",
            True,
            "return Poses(*poses(place, np.random.normal()))",
            "its answers to the same case differ between two calls",
        ),
        (
            "deterministic",
            False,
            "self.asked = getattr(self, 'asked', 0) + 1\nreturn Poses(*poses(place, self.asked))",
            "depends on earlier cases",
        ),
        (
            "columns",
            True,
            "return Poses(*poses(place), {'gust' if rng.random() > 0.4 else 'calm': 1.0})",
            "its columns change",
        ),
        ("columns", False, "return Poses(*poses(place), {'a b': 1.0})", "returns the invalid column name 'a b'"),
    ],
)
def test_motion_defects_are_reported(
    check: str, random: bool, lines: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = f"class Bad:\n    random = {random}\n    def fly(self, place, rng):\n" + textwrap.indent(lines, " " * 8)
    name = write_bad_part(tmp_path, monkeypatch, body)
    (result,) = run_suite(f"{name}:Bad", check).values()
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
    head = f"class Bad:\n    random = False\n    quantity = '{quantity}'\n    def read(self, truth, rng):\n"
    name = write_bad_part(tmp_path, monkeypatch, head + textwrap.indent(lines, " " * 8))
    (result,) = run_suite(f"{name}:Bad", check).values()
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
            "KEPT.append(1)\nreturn {'asked': len(KEPT)}",
            "its answers to the same case differ between two calls",
        ),
    ],
)
def test_score_defects_are_reported(
    check: str, annotation: str, lines: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = f"def bad(case: {annotation}):\n" + textwrap.indent(lines, " " * 4)
    name = write_bad_part(tmp_path, monkeypatch, body)
    (result,) = run_suite(f"{name}:bad", check).values()
    assert problem in result.problem


def test_nearest_ground_of_suite_matches_the_plane() -> None:
    """Compare with rays over the cone that are intersected with the plane."""
    apex = np.array([30.0, -20.0, 500.0])
    tilt = 0.4
    axis = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    across, along = np.array([0.0, 1.0, 0.0]), np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    half = np.radians(20.0)
    away, turn = np.meshgrid(np.linspace(0.0, half, 200), np.linspace(0.0, 2.0 * np.pi, 361))
    rays = (
        np.cos(away)[..., None] * axis
        + (np.sin(away) * np.cos(turn))[..., None] * along
        + (np.sin(away) * np.sin(turn))[..., None] * across
    )
    ranges = (apex[2] - 0.05 * apex[0]) / (0.05 * rays[..., 0] - rays[..., 2])
    nearest = suite.instrument_cases()[0].nearest_ground(apex, axis, half, 1e4)
    assert nearest == pytest.approx(float(ranges.min()), rel=1e-4)
