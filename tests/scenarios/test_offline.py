"""Tests of answer tables (CSV files that replace an algorithm), and of exported cases for offline algorithms."""

from pathlib import Path

import numpy as np
import pytest

from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.exchange import ExecutableLimits, read_case
from marsyard.algorithms.faults import AlgorithmError
from marsyard.algorithms.hda import HdaOptions
from marsyard.algorithms.interface import SiteOutcome, VelocityOutcome
from marsyard.scenarios.algorithm_labels import labels
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.custom_algorithms import algorithm_sources
from marsyard.scenarios.input_copies import hash_inputs
from marsyard.scenarios.landing_task import LANDING, SITE_FORMAT
from marsyard.scenarios.offline_algorithms import read_answers
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.velocity import VELOCITY, VELOCITY_FORMAT

LIMITS = ExecutableLimits()
HEADER = "case,outcome,velocity_east_m_s,velocity_north_m_s\n"
COVARIANCE = "covariance_east_m2_s2,covariance_east_north_m2_s2,covariance_north_m2_s2"


def write_table(folder: Path, text: str) -> Path:
    path = folder / "answers.csv"
    path.write_text(text)
    return path


def test_velocity_answers_are_read(tmp_path: Path) -> None:
    path = write_table(
        tmp_path, HEADER.strip() + f",{COVARIANCE}\n7,,1.5,-2,4,1,9\n\n 0 , NO_VALID_TRACK ,,,,,\n1,VALID,3,4,,,\n"
    )
    answers = read_answers(path, VELOCITY_FORMAT)
    assert sorted(answers) == [0, 1, 7]
    assert (answers[0].outcome, answers[0].velocity_m_s) == (VelocityOutcome.NO_VALID_TRACK, None)
    assert answers[7].outcome is VelocityOutcome.VALID
    assert np.array_equal(answers[7].velocity_m_s, [1.5, -2.0])  # type: ignore[arg-type]
    assert np.array_equal(answers[7].covariance_m2_s2, [[4.0, 1.0], [1.0, 9.0]])  # type: ignore[arg-type]
    assert answers[1].covariance_m2_s2 is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("case,velocity_east_m_s\n", "the column 'velocity_north_m_s' is missing"),
        ("case,velocity_east_km_h,velocity_north_m_s\n", "'velocity_east_km_h' (did you mean 'velocity_east_m_s'?)"),
        ("case,velocity_east_km_h,velocity_north_m_s\n", "the suffix of a name is its unit"),
        (f"case,{HEADER}", "duplicate column 'case'"),
        (f"{HEADER}1,VALID,2\n", "line 2: it has 3 cells; the first line has 4"),
        (f"{HEADER}-1,VALID,2,3\n", "line 2: case is '-1'; allowed: a whole number from 0"),
        (f"{HEADER}1,VALID,nan,3\n", "line 2: velocity_east_m_s is 'nan'; allowed: a finite number, or an empty cell"),
        (f"{HEADER}1,VALID,2,fast\n", "velocity_north_m_s is 'fast'; allowed: a finite number"),
        (f"{HEADER}1,VALID,2500,3\n", "velocity_east_m_s is 2500, beyond 1000; the suffix of the name"),
        (f"{HEADER}1,VALID,2,\n", "velocity_east_m_s is given, but velocity_north_m_s is not"),
        (f"{HEADER}1,,,\n", "neither an outcome nor numbers are given"),
        (f"{HEADER}1,GOOD,2,3\n", "outcome is 'GOOD'; allowed: VALID, NO_TEMPLATE_AREA"),
        (f"{HEADER}1,VALID,,\n", "outcome is VALID, but velocity_m_s is missing"),
        (f"{HEADER}1,NO_VALID_TRACK,2,3\n", "outcome is NO_VALID_TRACK, but velocity_m_s is given"),
        (f"{HEADER}1,VALID,2,3\n2,VALID,2,3\n1,VALID,2,3\n", "line 4: case 1 has two answers, the first in line 2"),
        (f"{HEADER.strip()},{COVARIANCE}\n1,,2,3,1,2,1\n", "covariance_m2_s2 is not positive definite"),
    ],
)
def test_invalid_tables_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = write_table(tmp_path, text)
    with pytest.raises(ValueError, match=r"answers\.csv") as error_info:
        read_answers(path, VELOCITY_FORMAT)
    assert message in str(error_info.value)


def test_all_errors_are_reported_up_to_a_limit(tmp_path: Path) -> None:
    path = write_table(tmp_path, HEADER + "".join(f"{case},VALID,x,1\n" for case in range(30)))
    with pytest.raises(ValueError, match=r"(?s)line 2:.*line 21:.*\.\.\. and 10 more"):
        read_answers(path, VELOCITY_FORMAT)
    with pytest.raises(ValueError, match="No such file"):
        VELOCITY.check(f"answers:{tmp_path}/nothing.csv")


def test_answer_table_replaces_an_algorithm(tmp_path: Path) -> None:
    spec = f"answers:{write_table(tmp_path, HEADER + '3,,1,2')}"
    VELOCITY.check(spec)
    assert labels(["dimes", spec]) == ("dimes", "answers")
    assert algorithm_sources(spec) == []
    answer = VELOCITY.make(spec, DimesOptions(), LIMITS, 3).estimate(inputs.descent())
    assert np.array_equal(answer.velocity_m_s, [1.0, 2.0])  # type: ignore[arg-type]
    with pytest.raises(AlgorithmError, match=r"answers\.csv has no answer to case 4"):
        VELOCITY.make(spec, DimesOptions(), LIMITS, 4).estimate(inputs.descent())
    with pytest.raises(ValueError, match="a target tracker cannot run offline"):
        TRACKING.check(spec)


def test_landing_site_answers_are_read(tmp_path: Path) -> None:
    path = write_table(
        tmp_path,
        "case,outcome,site_east_m,site_north_m,site_up_m\n0,SAFE_SITE,1,2,3\n1,NO_SAFE_SITE,,,\n2,NO_MOTION,,,\n",
    )
    assert [entry.outcome for entry in read_answers(path, SITE_FORMAT).values()] == [
        SiteOutcome.SAFE_SITE,
        SiteOutcome.NO_SAFE_SITE,
        SiteOutcome.NO_MOTION,
    ]
    measurements = inputs.landing()
    sites = [
        LANDING.make(f"answers:{path}", HdaOptions(), LIMITS, case).estimate(measurements).site_world
        for case in range(3)
    ]
    assert np.array_equal(sites[0], [1.0, 2.0, 3.0])  # type: ignore[arg-type]
    assert sites[1] is None
    # An algorithm that does not converge reports the a-priori site.
    assert np.array_equal(sites[2], measurements.apriori_site_world)  # type: ignore[arg-type]


@pytest.mark.parametrize("task", ["velocity", "landing"])
def test_exported_cases_equal_the_measurements(tmp_path: Path, task: str) -> None:
    if task == "velocity":
        measurements = inputs.descent()
        answer = VELOCITY.make(f"export:{tmp_path}", DimesOptions(), LIMITS, 12).estimate(measurements)
        assert answer.velocity_m_s is None
        exported = read_case(tmp_path / "cases" / "000012")
        assert [hash_inputs(entry.counts) for entry in exported.images] == [
            hash_inputs(entry.counts) for entry in measurements.images
        ]
    else:
        site = LANDING.make(f"export:{tmp_path}", HdaOptions(), LIMITS, 12).estimate(inputs.landing())
        assert not site.outcome.converged
        assert read_case(tmp_path / "cases" / "000012").images[1].counts.dtype == np.uint16
    assert {path.suffix for path in (tmp_path / "cases" / "000012").iterdir()} == {".json", ".png", ".cahvor", ".f64"}
    assert [path.name for path in (tmp_path / "cases").iterdir()] == ["000012"]
