"""Tests of the conformance suite for algorithms: shipped algorithms pass, and defects are reported."""

import textwrap
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.running.conformance import run_conformance_checks
from marsyard.scenarios.conformance import inputs, trackers
from marsyard.scenarios.conformance.candidates import Subject, determine_task
from marsyard.scenarios.conformance.inputs import TexturedPlane
from marsyard.scenarios.landing_task import LANDING
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.velocity import VELOCITY
from marsyard.sim.camera import Cahv
from tests.scenarios.suites import run_suite, write_module

MODULE_HEADER = """
import os, random, signal, sys
import numpy as np
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome as Outcome
from marsyard.algorithms.vtt import VisualTargetTracker, VttOptions
NO_ANSWER = VelocityEstimate(Outcome.NO_VALID_TRACK, None)
def has_texture(m):
    return m.images[0].counts.std() > 5
"""


@pytest.mark.parametrize(
    "spec",
    [
        "dimes",
        "vtt",
        "hda",
        *(
            pytest.param(spec, marks=pytest.mark.slow)
            for spec in (*VELOCITY.shipped, *TRACKING.shipped, *LANDING.shipped)
            if spec not in ("dimes", "vtt", "hda")
        ),
        pytest.param("velocity_estimator:MedianShift", marks=pytest.mark.slow),
        pytest.param("velocity_stream:ChainedShifts", marks=pytest.mark.slow),
        pytest.param("velocity_stream:IntegratedShifts", marks=pytest.mark.slow),
    ],
)
def test_shipped_algorithms_conform(spec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
    assert {name: finding.problem for name, finding in run_suite(spec).items() if not finding.passed} == {}


def write_defective_module(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> str:
    """Write a module with a class `Defective` and return the import path of the class."""
    return f"{write_module(folder, monkeypatch, MODULE_HEADER + textwrap.dedent(body))}:Defective"


def format_estimator(lines: str) -> str:
    """Return the source of a class `Defective` with these lines in its method `estimate`."""
    return "class Defective:\n    def estimate(self, m):\n" + textwrap.indent(textwrap.dedent(lines), " " * 8)


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
        ("answer", "m.images[0].counts[:] = m.images[0].counts\nreturn NO_ANSWER", "read-only"),
        ("featureless", "return VelocityEstimate(Outcome.VALID, np.zeros(2))", "it answers VALID to images that are"),
        ("saturated", "return NO_ANSWER if has_texture(m) else 1 / 0", "it raised ZeroDivisionError"),
        ("inputs", "m.images[0].counts[:] = 0\nreturn NO_ANSWER", "it changed its input"),
        ("inputs", "m.interval_velocities_m_s[0] -= 1\nreturn NO_ANSWER", "it changed its input"),
        ("deterministic", "return VelocityEstimate(Outcome.VALID, np.random.random(2))", "differ between two calls"),
        # The answer is the mean brightness of the previous case.
        (
            "deterministic",
            "global LAST_MEAN\nprevious = globals().get('LAST_MEAN', 0.0)\nLAST_MEAN = m.images[0].counts.mean()\n"
            "return VelocityEstimate(Outcome.VALID, np.full(2, previous))",
            "answer",
        ),
        ("truth", "import marsyard.sim.terrain\nreturn NO_ANSWER", "it imports modules with access to the truth: bad_"),
        ("truth", "from marsyard.sim import sensor\nreturn NO_ANSWER", ": marsyard.sim.sensor"),
    ],
)
def test_estimator_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, lines: str, problem: str
) -> None:
    result = run_suite(write_defective_module(tmp_path, monkeypatch, format_estimator(lines)), check)[check]
    assert problem in result.problem
    assert result.next_step


STREAM_TEMPLATE = """
class Defective:
    def start(self):
        self.frames = []
    def process_image(self, frame):
        self.frames.append(frame)
        {image}
    def finish(self):
        {finish}
"""
VALID_AFTER_TWO_IMAGES = "return VelocityEstimate(Outcome.VALID, np.ones(2)) if len(self.frames) > 1 else NO_ANSWER"


@pytest.mark.parametrize(
    ("check", "image", "finish", "problem"),
    [
        ("answer", "return 3.0", "return NO_ANSWER", "BAD_ANSWER: the answer is a float"),
        ("answer", "return None", "return None", "BAD_ANSWER: the answer is a NoneType"),
        ("answer", "return VelocityEstimate(Outcome.VALID, np.ones(2))", "return NO_ANSWER", "no last interval"),
        (
            "answer",
            "return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(99.0, 101.0))",
            "return NO_ANSWER",
            "within the images' time tags, 100.0 to 100.0 s",
        ),
        ("answer", "return None", "return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(105.0, 101.0))", "first"),
        ("saturated", "return None", VALID_AFTER_TWO_IMAGES, "it answers VALID to images that are saturated"),
        ("inputs", "frame.image.counts[:] = 0", "return NO_ANSWER", "it changed its input"),
        (
            "inputs",
            "frame.interval_velocity_m_s is None or frame.interval_velocity_m_s.fill(0)",
            VALID_AFTER_TWO_IMAGES,
            "it changed its input",
        ),
        ("few", "return None", "return NO_ANSWER if len(self.frames) == 1 else 1 / 0", "ZeroDivisionError"),
        (
            "few",
            "return None",
            "t = self.frames[-1].image.time_s if self.frames else 0.0\n"
            "        return VelocityEstimate(Outcome.VALID, np.ones(2), span_s=(t, t))",
            "it answers VALID to zero images and to one image: no motion",
        ),
        ("number", "return None", "one, two, three = self.frames[:3]\n        return NO_ANSWER", "not enough values"),
    ],
)
def test_stream_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, image: str, finish: str, problem: str
) -> None:
    body = STREAM_TEMPLATE.format(image=image, finish=finish)
    assert problem in run_suite(write_defective_module(tmp_path, monkeypatch, body), check)[check].problem


def test_stream_with_state_from_earlier_descents_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
    class Defective:
        total = 0.0
        def start(self): pass
        def process_image(self, frame): self.total += frame.image.counts.mean()
        def finish(self): return VelocityEstimate(Outcome.VALID, np.full(2, self.total), span_s=(100.0, 100.0))
    """
    result = run_suite(write_defective_module(tmp_path, monkeypatch, body), "deterministic", "start", "time")
    assert result["deterministic"].problem == "after another descent, its answers differ"
    assert result["start"].problem == "after a restart in the middle of a descent, its answers differ"
    assert result["time"].passed


def test_estimator_with_state_from_earlier_cases_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
    class Defective:
        def __init__(self):
            self.before = np.zeros(2)
        def estimate(self, m):
            answer, self.before = self.before, self.before + m.images[0].counts.mean()
            return VelocityEstimate(Outcome.VALID, answer)
    """
    result = run_suite(write_defective_module(tmp_path, monkeypatch, body), "deterministic", "inputs", "time")
    assert result["deterministic"].problem == "its answer depends on earlier cases"
    assert result["inputs"].passed
    assert result["time"].passed


@pytest.mark.parametrize(
    ("check", "method", "problem"),
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
        ("truth", "def update(self, m): import marsyard.sim.terrain; return super().update(m)", "to the truth: bad_"),
    ],
)
def test_tracker_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, method: str, problem: str
) -> None:
    # The shipped tracker is `typing.final`, which Python does not enforce.
    spec = write_defective_module(tmp_path, monkeypatch, f"class Defective(VisualTargetTracker):\n    {method}\n")
    assert problem in run_suite(spec, check)[check].problem


def test_task_is_inferred_from_name_and_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [determine_task(name) for name in ("homography", "semi-global", "pure-ncc", "exec:cat")] == [
        "velocity",
        "landing",
        "tracking",
        "velocity",
    ]
    assert determine_task("marsyard.algorithms.hda:HdaEstimator") == "landing"
    assert determine_task("marsyard.algorithms.vtt:VisualTargetTracker") == "tracking"
    spec = write_defective_module(tmp_path, monkeypatch, format_estimator("return NO_ANSWER"))
    assert determine_task(spec) == "velocity"
    with pytest.raises(ValueError, match="unknown algorithm 'vt'"):
        determine_task("vt")
    with pytest.raises(ValueError, match="cannot import algorithm 'nowhere:Nothing'"):
        determine_task("nowhere:Nothing")


def test_rendered_plane_has_correct_parallax() -> None:
    """A shift of the plane by s moves the image by s times focal length / distance pixels."""
    downwards, right = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    camera = Cahv.from_axes((500.0, 500.0), (64, 48), axis=downwards, right=right, centre=np.array([0.0, 0.0, 10.0]))
    plane = TexturedPlane(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 0.02)
    radiance = plane.radiance(camera)
    # With a focal length of 500 px, 0.02 m at 10 m is 1 px: the image shifts by one column.
    shifted_plane = TexturedPlane(np.array([0.02, 0.0, 0.0]), plane.axes, plane.step_m)
    assert np.allclose(shifted_plane.radiance(camera)[:, 1:], radiance[:, :-1], atol=1e-6)
    plane_behind_camera = TexturedPlane(np.array([0.0, 0.0, 20.0]), plane.axes, plane.step_m)
    assert np.ptp(plane_behind_camera.radiance(camera)) == 0.0


def test_inputs_of_the_suite_are_physically_consistent() -> None:
    descent, landing = inputs.descent(), inputs.landing()
    five_images = inputs.descent(5)
    assert (len(five_images.images), five_images.images[4].time_s) == (5, 107.5)
    assert len(five_images.interval_velocities_m_s) == 4
    assert descent.images[0].counts.shape == (256, 1024)
    assert 200 < descent.images[0].counts.mean() < 4000
    # The laser ray ends on the ground.
    assert abs(landing.apriori_site_world[2]) < 1e-9
    blank = inputs.make_blank(descent, inputs.BLANKS["saturated"])
    assert {int(image.counts.min()) for image in blank.images} == {4095}
    assert trackers.take_images(trackers.aim_ahead(), trackers.pose(0.0)).left.counts.std() > 100


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ("os.chdir('/')", "it changed the state of its process: "),
        ("os.environ['X_TEST'] = '1'", "it changed the state of its process: "),
        ("signal.signal(signal.SIGTERM, signal.SIG_IGN)", "it changed the state of its process: "),
    ],
)
def test_changed_process_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: str, problem: str) -> None:
    """Each check runs in its own process; the suite compares the state of the process before and after."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    spec = write_defective_module(tmp_path, monkeypatch, format_estimator(f"{lines}\nreturn NO_ANSWER"))
    first_check = next(iter(run_conformance_checks(Subject(spec, "velocity", 60.0))))
    assert (first_check.check, first_check.passed) == ("answer", False)
    assert problem in first_check.problem
    assert first_check.next_step
