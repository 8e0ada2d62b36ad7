"""Tests of custom parts (user-defined motions, instruments and scores): lookup, options, and error messages."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.components import list_parts
from marsyard.campaigns.definition.identity import custom_sources
from marsyard.campaigns.definition.toml_models import validation_problems
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.parts import named
from marsyard.scenarios.parts.motions import CustomMotion
from marsyard.scenarios.parts.named import DYNAMICS, SCORE, check_columns
from marsyard.scenarios.parts.scores import (
    SCORED,
    ScoredDescent,
    ScoredFlight,
    ScoredLanding,
    accepted_cases,
    load_score,
)

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"


@pytest.fixture(autouse=True)
def _add_examples_to_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))


def find_problem(**parts: Any) -> tuple[str, str]:
    """Validate descent parameters that contain one error; return its key and message."""
    with pytest.raises(ValidationError) as error_info:
        DescentScenarioParameters.model_validate(parts)
    ((key, message),) = validation_problems(error_info.value, DescentScenarioParameters)
    return ".".join(map(str, key)), message


@pytest.mark.parametrize(
    ("parts", "key", "message"),
    [
        ({"flight": {"motion": "nowhere:X"}}, "flight", "cannot import motion 'nowhere:X': No module named 'nowhere'"),
        ({"flight": {"motion": "custom_parts:Glidr"}}, "flight", "has no attribute 'Glidr'"),
        ({"flight": {"motion": "glidr"}}, "flight", "unknown motion 'glidr'; allowed: a custom one as module:name"),
        ({"flight": {"motion": "custom_parts:lateral_impact"}}, "flight", "not a valid motion: it is a function"),
        ({"flight": {"motion": "custom_parts:StarTracker"}}, "flight", "is not a valid motion: missing members: fly"),
        (
            {"flight": {"motion": "custom_parts:Glider", "options": {"glide": 1.0}}},
            "flight",
            "unexpected keyword argument 'glide'; available options: height_m, speed_m_s, glide_ratio, roll_deg",
        ),
        (
            {"flight": {"motion": "custom_parts:Glider", "options": {"glide_ratio": 9.0}}},
            "flight",
            "': glide_ratio is 9.0; allowed: 0 to 5",
        ),
        (
            {"flight": {"motion": "custom_parts:Glider", "heading_offset_deg": 1.0}},
            "flight.heading_offset_deg",
            "unknown key",
        ),
        (
            {"altimeter": {"instrument": "custom_parts:StarTracker"}},
            "altimeter",
            "'custom_parts:StarTracker' measures 'attitude'; allowed here: 'altitude'",
        ),
        (
            {"attitude_source": {"instrument": "custom_parts:StarTracker", "options": {"noise_deg": float("nan")}}},
            "attitude_source",
            "not JSON compliant",
        ),
        ({"altimeter": {"beam": 2.0}}, "altimeter.beam", "did you mean 'beam_deg'?"),
        ({"scores": ["custom_parts:Glider"]}, "scores", "is not a valid score: it is a class, not a function"),
        ({"scores": ["custom_parts:MASS_KG"]}, "scores", "is not a valid score: it is a float, not a function"),
        (
            {"scores": ["custom_parts:lateral_impact"] * 2},
            "scores",
            "the score 'custom_parts:lateral_impact' is listed twice",
        ),
    ],
)
def test_errors_are_reported_with_the_invalid_key(parts: dict[str, Any], key: str, message: str) -> None:
    reported_key, reported_message = find_problem(**parts)
    assert reported_key == key
    assert message in reported_message


def test_module_that_raises_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "raises_at_import.py").write_text("raise RuntimeError('no licence')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "RuntimeError: no licence" in find_problem(flight={"motion": "raises_at_import:Any"})[1]


def test_options_of_parts_have_defaults_and_round_trip() -> None:
    parameters = DescentScenarioParameters.model_validate(
        {"flight": {"motion": "custom_parts:Glider", "options": {"glide_ratio": 0.25}}}
    )
    assert isinstance(parameters.flight, CustomMotion)
    assert parameters.flight.options == {"height_m": 1800.0, "speed_m_s": 60.0, "glide_ratio": 0.25, "roll_deg": 8.0}
    assert parameters.flight.create().glide_ratio == 0.25
    assert DescentScenarioParameters.model_validate(parameters.model_dump(mode="json")) == parameters


def test_part_is_found_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        named, "list_installed", lambda group: {"glider": "custom_parts:Glider"} if group in DYNAMICS.group else {}
    )
    assert type(DYNAMICS.create("glider", {})).__name__ == "Glider"
    with pytest.raises(ValueError, match=r"unknown motion 'glidr' \(did you mean 'glider'\?\)"):
        DYNAMICS.load("glidr")
    with pytest.raises(ValueError, match="unknown score 'glider'"):
        SCORE.load("glider")


def test_score_annotation_determines_its_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "custom_scores.py").write_text(
        "from marsyard.scenarios.parts import ScoredDescent, ScoredFlight, ScoredLanding\n"
        "def any_case(case): return {}\n"
        "def descent_or_landing(case: ScoredDescent | ScoredLanding): return {}\n"
        "def landing(case: 'ScoredLanding'): return {}\n"
        "def flight(case: ScoredFlight): return {}\n"
        "def without_argument(): return {}\n"
        "class CallableScore:\n    def __call__(self, case: ScoredLanding): return {}\n"
        "callable_object = CallableScore()\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    names = ("any_case", "descent_or_landing", "landing", "flight", "callable_object")
    case_types = {name: accepted_cases(load_score(f"custom_scores:{name}")) for name in names}
    assert case_types["any_case"] == SCORED
    assert case_types["descent_or_landing"] == (ScoredDescent, ScoredLanding)
    assert case_types["landing"] == case_types["callable_object"] == (ScoredLanding,)
    # ScoredFlight is a base class of ScoredDescent.
    assert case_types["flight"] == (ScoredFlight, ScoredDescent)
    with pytest.raises(ValueError, match="accepts ScoredLanding; allowed here: ScoredDescent"):
        load_score("custom_scores:landing", ScoredDescent)
    with pytest.raises(ValueError, match="must accept one argument"):
        load_score("custom_scores:without_argument")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ([1.0], "returns columns of type list; allowed: a mapping"),
        ({"a b": 1.0}, "returns the invalid column name 'a b'"),
        ({"ä": 1.0}, "returns the invalid column name 'ä'"),
        ({"a": "text"}, "returns a of type str; allowed: a number, true or false"),
        ({"a": None}, "returns a of type NoneType"),
    ],
)
def test_invalid_columns_are_rejected(columns: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_columns("x:y", columns, texts=False)


def test_campaign_identity_includes_the_modules_of_parts() -> None:
    """Custom parts occur in parameters, as a dispersed value, and in a dispersed table."""
    definition = CampaignDefinition.model_validate(
        {
            "name": "parts",
            "scenario": "descent",
            "cases": 1,
            "parameters": {
                "scores": ["mine.scores:energy"],
                "flight": {"motion": "custom_parts:Glider"},
                "altimeter": {},
            },
            "dispersions": {
                "flight.motion": {
                    "distribution": "choice",
                    "values": ["custom_parts:Glider", "other:Falling"],
                    "source": "-",
                },
                "altimeter": {
                    "distribution": "choice",
                    "values": [{"beam_deg": 3.0}, {"instrument": "custom_parts:PulsedLidar"}],
                    "source": "-",
                },
            },
        }
    )
    assert list_parts(definition) == (
        "custom_parts:Glider",
        "mine.scores:energy",
        "other:Falling",
        "custom_parts:PulsedLidar",
    )
    assert list(custom_sources("custom_parts:Glider")) == [("custom_parts.py", EXAMPLES / "custom_parts.py")]
