"""Tests of the conformance suite for algorithms: shipped algorithms pass, and defects are reported."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.running.replay import run_conformance_checks
from marsyard.scenarios.conformance import Finding, Subject, check_names, determine_task, inputs, run_check, trackers
from marsyard.scenarios.conformance.inputs import TexturedPlane
from marsyard.scenarios.estimators import LANDING, TRACKING, VELOCITY
from marsyard.sim.camera import Cahv

HEAD = """
import os, random, signal, sys
import numpy as np
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome as Outcome
from marsyard.algorithms.vtt import VisualTargetTracker, VttOptions
NOTHING = VelocityEstimate(Outcome.NO_VALID_TRACK, None)
def seen(m):
    return m.images[0].counts.std() > 5
"""


def run_suite(spec: str, *only: str) -> dict[str, Finding]:
    subject = Subject(spec, determine_task(spec), 60.0)
    names = [name for name, _ in check_names(subject)]
    return {name: run_check(subject, names.index(name)) for name in (only or names)}


@pytest.mark.parametrize(
    "spec",
    [
        *VELOCITY.shipped,
        *TRACKING.shipped,
        *LANDING.shipped,
        "velocity_estimator:MedianShift",
        "velocity_stream:ChainedShifts",
    ],
)
def test_shipped_algorithms_conform(spec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
    assert {name: one.problem for name, one in run_suite(spec).items() if not one.passed} == {}


def write_bad_module(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> str:
    """Write a module with a class `Bad` and a unique name to the current folder, as Python caches modules."""
    name = f"bad_{abs(hash(body))}"
    (folder / f"{name}.py").write_text(HEAD + textwrap.dedent(body))
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return f"{name}:Bad"


def format_estimator(lines: str) -> str:
    return "class Bad:\n    def estimate(self, m):\n" + textwrap.indent(textwrap.dedent(lines), " " * 8)


@pytest.mark.parametrize(
    ("check", "lines", "problem"),
    [
        ("answer", "return (1.0, 2.0)", "BAD_ANSWER: the answer is a tuple; allowed: a VelocityEstimate"),
        ("answer", "return VelocityEstimate(Outcome.VALID, np.full(2, np.nan))", "velocity_m_s is not finite"),
        (
            "answer",
            "return VelocityEstimate(Outcome.VALID, np.ones(2), None, np.full((2, 2), np.nan))",
            "covariance_m2_s2 is not finite",
        ),
        ("answer", "return 1 / 0", "it raised ZeroDivisionError: division by zero (bad_"),
        ("answer", "m.images[0].counts[:] = m.images[0].counts\nreturn NOTHING", "read-only"),
        ("featureless", "return VelocityEstimate(Outcome.VALID, np.zeros(2))", "it answers VALID to images that are"),
        ("saturated", "return NOTHING if seen(m) else 1 / 0", "it raised ZeroDivisionError"),
        ("inputs", "m.images[0].counts[:] = 0\nreturn NOTHING", "it changed its input"),
        ("inputs", "m.interval_velocities_m_s[0] -= 1\nreturn NOTHING", "it changed its input"),
        ("deterministic", "return VelocityEstimate(Outcome.VALID, np.random.random(2))", "differ between two calls"),
        (
            "deterministic",
            "global KEPT\nwas = globals().get('KEPT', 0.0)\nKEPT = m.images[0].counts.mean()\n"
            "return VelocityEstimate(Outcome.VALID, np.full(2, was))",
            "answer",
        ),
        ("truth", "import marsyard.sim.terrain\nreturn NOTHING", "it imports modules with access to the truth: bad_"),
        ("truth", "from marsyard.sim import sensor\nreturn NOTHING", ": marsyard.sim.sensor"),
    ],
)
def test_estimator_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, lines: str, problem: str
) -> None:
    result = run_suite(write_bad_module(tmp_path, monkeypatch, format_estimator(lines)), check)[check]
    assert problem in result.problem
    assert result.next_step


STREAM = """
class Bad:
    def start(self):
        self.kept = []
    def picture(self, frame):
        self.kept.append(frame)
        {picture}
    def finish(self):
        {finish}
"""
MOVING = "return VelocityEstimate(Outcome.VALID, np.ones(2)) if len(self.kept) > 1 else NOTHING"


@pytest.mark.parametrize(
    ("check", "picture", "finish", "problem"),
    [
        ("answer", "return 3.0", "return NOTHING", "BAD_ANSWER: the answer is a float"),
        ("answer", "return None", "return None", "BAD_ANSWER: the answer is a NoneType"),
        ("answer", "return VelocityEstimate(Outcome.VALID, np.ones(2))", "return NOTHING", "no last interval"),
        (
            "answer",
            "return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(99.0, 101.0))",
            "return NOTHING",
            "within the images' time tags, 100.0 to 100.0 s",
        ),
        ("answer", "return None", "return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(105.0, 101.0))", "first"),
        ("saturated", "return None", MOVING, "it answers VALID to images that are saturated"),
        ("inputs", "frame.image.counts[:] = 0", "return NOTHING", "it changed its input"),
        (
            "inputs",
            "frame.interval_velocity_m_s is None or frame.interval_velocity_m_s.fill(0)",
            MOVING,
            "it changed its input",
        ),
        ("few", "return None", "return NOTHING if len(self.kept) == 1 else 1 / 0", "ZeroDivisionError"),
        (
            "few",
            "return None",
            "t = self.kept[-1].image.time_s if self.kept else 0.0\n"
            "        return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(t, t))",
            "it answers VALID to no image",
        ),
        ("number", "return None", "first, second, third = self.kept[:3]\n        return NOTHING", "not enough values"),
    ],
)
def test_stream_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, picture: str, finish: str, problem: str
) -> None:
    body = STREAM.format(picture=picture, finish=finish)
    assert problem in run_suite(write_bad_module(tmp_path, monkeypatch, body), check)[check].problem


def test_state_kept_between_descents_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
    class Bad:
        seen = 0.0
        def start(self): pass
        def picture(self, frame): self.seen += frame.image.counts.mean()
        def finish(self): return VelocityEstimate(Outcome.VALID, np.full(2, self.seen), span_s=(100.0, 100.0))
    """
    result = run_suite(write_bad_module(tmp_path, monkeypatch, body), "deterministic", "start", "time")
    assert result["deterministic"].problem == "its answer depends on earlier cases"
    assert result["start"].problem == "after a restart in the middle of a descent, its answer differs"
    assert result["time"].passed


def test_estimator_state_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
    class Bad:
        def __init__(self):
            self.before = np.zeros(2)
        def estimate(self, m):
            answer, self.before = self.before, self.before + m.images[0].counts.mean()
            return VelocityEstimate(Outcome.VALID, answer)
    """
    result = run_suite(write_bad_module(tmp_path, monkeypatch, body), "deterministic", "inputs", "time")
    assert result["deterministic"].problem == "its answer depends on earlier cases"
    assert result["inputs"].passed
    assert result["time"].passed


@pytest.mark.parametrize(
    ("check", "changed", "problem"),
    [
        ("answer", "def update(self, m): return None", "BAD_ANSWER: the answer is a NoneType; allowed: a TargetUpdate"),
        ("answer", "def aim(self, pose, mast): return (0.0, 0.0)", "the aim is a tuple; allowed: a MastAim, or None"),
        ("states", "def clear(self): pass", "its state after clear is TrackingState.NORMAL"),
        (
            "deterministic",
            "def clear(self): pass\n    def designate(self, t, p): self.track or super().designate(t, p)",
            "after clear and a second designation of the target, its answer differs",
        ),
        ("inputs", "def update(self, m): m.left.counts[:] = 0; return super().update(m)", "it changed its input"),
        (
            "truth",
            "def update(self, m): import marsyard.sim.terrain; return super().update(m)",
            "access to the truth: bad_",
        ),
    ],
)
def test_tracker_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, changed: str, problem: str
) -> None:
    # Only type checkers treat the shipped tracker as final.
    spec = write_bad_module(tmp_path, monkeypatch, f"class Bad(VisualTargetTracker):\n    {changed}\n")
    assert problem in run_suite(spec, check)[check].problem


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ("os.chdir('/')", "it changed the state of its process: "),
        ("os.environ['X_OF_MINE'] = '1'", "it changed the state of its process: "),
        ("signal.signal(signal.SIGTERM, signal.SIG_IGN)", "it changed the state of its process: "),
    ],
)
def test_changed_process_state_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: str, problem: str
) -> None:
    """Each check runs in a process whose state is compared afterwards."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    spec = write_bad_module(tmp_path, monkeypatch, format_estimator(f"{lines}\nreturn NOTHING"))
    first = next(iter(run_conformance_checks(Subject(spec, "velocity", 60.0))))
    assert (first.check, first.passed) == ("answer", False)
    assert problem in first.problem
    assert first.next_step


def test_task_is_inferred_from_name_and_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [determine_task(name) for name in ("homography", "semi-global", "pure-ncc", "exec:cat")] == [
        "velocity",
        "landing",
        "tracking",
        "velocity",
    ]
    assert determine_task("marsyard.algorithms.hda:HdaEstimator") == "landing"
    assert determine_task("marsyard.algorithms.vtt:VisualTargetTracker") == "tracking"
    assert determine_task(write_bad_module(tmp_path, monkeypatch, format_estimator("return NOTHING"))) == "velocity"
    with pytest.raises(ValueError, match="unknown algorithm 'vt'"):
        determine_task("vt")
    with pytest.raises(ValueError, match="cannot import algorithm 'nowhere:Nothing'"):
        determine_task("nowhere:Nothing")


def test_rendered_plane_has_correct_parallax() -> None:
    """A step of one sample along the plane moves the image by focal length / distance pixels."""
    down, right = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    camera = Cahv.from_axes((500.0, 500.0), (64, 48), axis=down, right=right, centre=np.array([0.0, 0.0, 10.0]))
    plane = TexturedPlane(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 0.02)
    before = plane.radiance(camera)
    # 0.02 m at 10 m is 1 px: the image shifts by one column.
    moved = TexturedPlane(np.array([0.02, 0.0, 0.0]), plane.axes, plane.step_m)
    assert np.allclose(moved.radiance(camera)[:, 1:], before[:, :-1], atol=1e-6)
    away = TexturedPlane(np.array([0.0, 0.0, 20.0]), plane.axes, plane.step_m)
    assert np.ptp(away.radiance(camera)) == 0.0


def test_inputs_are_physically_consistent() -> None:
    descent, landing = inputs.descent(), inputs.landing()
    many = inputs.descent(5)
    assert (len(many.images), many.images[4].time_s, len(many.interval_velocities_m_s)) == (5, 107.5, 4)
    assert descent.images[0].counts.shape == (256, 1024)
    assert 200 < descent.images[0].counts.mean() < 4000
    # The laser ray ends on the ground.
    assert abs(landing.apriori_site_world[2]) < 1e-9
    blank = inputs.blank_pictures(descent, inputs.BLANKS["saturated"])
    assert {int(one.counts.min()) for one in blank.images} == {4095}
    assert trackers.take_images(trackers.aim_ahead(), trackers.pose(0.0)).left.counts.std() > 100
