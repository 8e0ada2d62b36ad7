"""Tests of the conformance suite for position estimators: shipped estimators pass, and defects are reported."""

import sys
import textwrap
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from marsyard.algorithms.localisation.navigation_filter import LocalisationFilter
from marsyard.campaigns.running.conformance import create_subject
from marsyard.scenarios.conformance.candidates import Subject, determine_task, list_checks, subject_kinds
from marsyard.scenarios.localisation import conformance as inputs
from marsyard.sim.measurements import ImuIncrements
from tests.scenarios import suites

MODULE_HEADER = """
import numpy as np
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome as Outcome
"""


run_suite = partial(suites.run_suite, task="localisation")


@pytest.mark.parametrize(
    ("spec", "checks"),
    [
        ("inertial", ()),
        # all checks of the other two take 15 s each
        ("lvs", ("answer", "black")),
        ("sift", ("answer", "dark")),
    ],
)
def test_shipped_estimators_conform(spec: str, checks: tuple[str, ...]) -> None:
    findings = run_suite(spec, *checks)
    assert {name: finding.problem for name, finding in findings.items() if not finding.passed} == {}
    if spec != "inertial":
        # the position is found on these inputs, so that the checks execute all stages
        assert "VALID; " in findings["answer"].note
        assert float(findings["answer"].note.split("; ")[1].split(" m ")[0]) < 20.0


def write_defective_module(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> str:
    """Write a module with a class `Defective` and return the import path of the class."""
    source = f"{MODULE_HEADER}class Defective(InertialEstimator):\n{body}\n"
    return f"{suites.write_module(folder, monkeypatch, source)}:Defective"


@pytest.mark.parametrize(
    ("check", "method", "problem"),
    [
        ("answer", "def process_image(self, image): return None", "BAD_ANSWER: the answer is a NoneType; allowed: a P"),
        ("answer", "def finish(self): return PositionEstimate(Outcome.VALID, 8.0)", "but position_m is missing"),
        (
            "answer",
            "def process_image(self, image): return PositionEstimate(Outcome.UNCERTAIN, image.time_s + 0.5)",
            "BAD_ANSWER: time_s of the answer to image 1 is 1.5 s; allowed: 1.0 s, its time tag",
        ),
        (
            "answer",
            "def finish(self): return PositionEstimate(Outcome.UNCERTAIN, 99.0)",
            "answer to finish is 99.0 s; allowed: 8.0",
        ),
        ("answer", "def process_image(self, image): image.counts[:] = 0", "it raised ValueError"),
        ("black", "def process_image(self, image): return 1 // int(image.counts.max())", "it raised ZeroDivisionError"),
        ("saturated", "def process_image(self, image): assert image.counts.min() < 255", "it raised AssertionError"),
        # duplicated image
        (
            "repeated",
            """
            last = None
            def process_image(self, image):
                assert image.time_s != self.last
                self.last = image.time_s
                return super().process_image(image)
            """,
            "it raised AssertionError",
        ),
        # the next two read an attribute that exists only after the first altitude or image
        (
            "no-altitudes",
            """
            def process_altitude(self, measurement): self.last = measurement
            def process_image(self, image): return PositionEstimate(Outcome.UNCERTAIN, image.time_s, self.last and None)
            """,
            "it raised AttributeError: 'Defective' object has no attribute 'last'",
        ),
        (
            "no-images",
            """
            def process_image(self, image):
                self.last = super().process_image(image)
                return self.last
            def finish(self): return self.last and super().finish()
            """,
            "it raised AttributeError",
        ),
        (
            "jitter",
            "def process_increments(self, item): assert np.diff(item.times_s).min() > 0",
            "it raised AssertionError",
        ),
        (
            "inputs",
            "def process_image(self, image): image.counts[:] = 0; return super().process_image(image)",
            "it changed its input",
        ),
        ("inputs", "def start(self, i, m): super().start(i, m); m.appearance[0, 0] += 1", "it changed its input"),
        (
            "deterministic",
            """
            def process_image(self, image):
                return PositionEstimate(Outcome.UNCERTAIN, image.time_s + 1e-7 * np.random.random())
            """,
            "its answers to the same case differ between two calls",
        ),
        # `start` does not reset the counters of the next two
        (
            "deterministic",
            """
            count = 0
            def process_altitude(self, measurement): self.count += 1
            def finish(self): return PositionEstimate(list(Outcome)[1 + self.count // 20], self._filter.time_s)
            """,
            "after another descent, its answers differ",
        ),
        (
            "start",
            """
            count = 0
            def process_image(self, image):
                self.count += 1
                return PositionEstimate(list(Outcome)[1 + self.count % 2], image.time_s)
            """,
            "after a restart in the middle of a descent, its answers differ",
        ),
        (
            "truth",
            "def finish(self): import marsyard.sim.terrain; return super().finish()",
            "access to the truth: bad_",
        ),
    ],
)
def test_defects_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: str, method: str, problem: str
) -> None:
    spec = write_defective_module(tmp_path, monkeypatch, textwrap.indent(textwrap.dedent(method), " " * 4))
    finding = run_suite(spec, check)[check]
    assert problem in finding.problem
    assert not finding.passed
    assert finding.next_step


def test_slow_estimator_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = "    def process_image(self, image): import time; time.sleep(0.02); return super().process_image(image)"
    finding = run_suite(write_defective_module(tmp_path, monkeypatch, body), "time", limit_s=0.01)["time"]
    assert float(finding.problem.split()[2]) >= 0.02  # a loaded machine takes longer
    assert not finding.passed
    assert finding.requirement == "answers each image within 0.01 s"


#: A program of the file exchange. It executes its argument, Python code, before each answer to `image` and `finish`.
PROGRAM = """
import json, sys, time
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
time_s, images, body = 0.0, 0, sys.argv[1]
for line in sys.stdin:
    request = json.loads(line)
    answer = {"outcome": None}
    if request["do"] == "process_increments":
        time_s = request["increments"]["times_s"][-1]
    if request["do"] in ("process_image", "finish"):
        images += 1
        tag = json.load(open(request["image"] + "/image.json"))["image"]["time_s"] if "image" in request else time_s
        answer = {"outcome": "UNCERTAIN", "time_s": tag}
        exec(body)
    print(json.dumps({"exchange": 3, "id": request["id"], **answer}), flush=True)
"""


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("pass", ""),
        ("sys.exit('the end')", "CRASHED: it ended with status 1; its standard error ends with: the end"),
        ("time.sleep(60)", "TIMED_OUT: no answer within 0.5 s"),
    ],
)
def test_faults_of_programs_are_reported(tmp_path: Path, body: str, problem: str) -> None:
    path = tmp_path / "estimator.py"
    path.write_text(PROGRAM)
    spec = f'serve:{sys.executable} {path} "{body}"'
    finding = run_suite(spec, "answer", limit_s=0.5 if "TIMED_OUT" in problem else 60.0)["answer"]
    assert finding.problem.startswith(problem)
    assert finding.passed == (problem == "")


def test_program_without_memory_of_earlier_descents_passes(tmp_path: Path) -> None:
    path = tmp_path / "estimator.py"
    path.write_text(PROGRAM)
    findings = run_suite(f"exec:{sys.executable} {path} pass", "no-images", "start")
    assert {name: finding.problem for name, finding in findings.items() if not finding.passed} == {}


def test_estimators_and_programs_have_the_localisation_suite() -> None:
    assert subject_kinds()[:4] == ("velocity", "tracking", "landing", "localisation")
    assert [determine_task(name) for name in ("lvs", "sift", "inertial")] == ["localisation"] * 3
    assert determine_task("marsyard.algorithms.localisation.estimator:MapRelativeEstimator") == "localisation"
    assert create_subject("inertial", None, 60.0).task == "localisation"
    names = [name for name, _ in list_checks(Subject("serve:cat", "localisation", 60.0))]
    assert "start" in names
    assert "inputs" not in names  # a program receives files


def test_inertial_data_are_exact() -> None:
    """Propagation preserves the error of the initial position: the increments have no errors."""
    case = inputs.ordinary_descent()
    navigation = LocalisationFilter.from_initial(case.initial)
    for event in case.events():
        if isinstance(event, ImuIncrements):
            navigation.propagate(event)
    error = navigation.estimate(float(case.increments.times_s[-1]))[0] - inputs.true_position(
        float(case.increments.times_s[-1])
    )
    # (160, -110, 20) m is the error of the initial position; the trapezoidal rule is exact for a constant force
    np.testing.assert_allclose(error, [160.0, -110.0, 20.0], atol=1e-3)
