"""Tests of loading campaign files: each problem is reported with its file or option, key and allowed values."""

import contextlib
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.claims import bank_seeds
from marsyard.campaigns.definition.components import list_algorithms
from marsyard.campaigns.definition.identity import hash_code
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError
from marsyard.scenarios.systems import catalogue
from tests.campaigns.fake_campaign import CampaignFile, to_toml

#: Module of the fake scenarios.
FAKE = "tests.campaigns.fake_scenario"


def load_and_expect_error(path: Path | str, *overrides: str, cases: int | None = None, seed: int | None = None) -> str:
    """Return the message of the error that loading the campaign raises."""
    with pytest.raises(DefinitionError) as error:
        load_campaign(str(path), overrides, cases, seed)
    return str(error.value)


def test_omitted_parameters_get_their_defaults(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file("altitude_m = 1500")))
    assert campaign.definition.parameters["altitude_m"] == 1500.0
    assert campaign.definition.parameters["wind"] == {"east_m_s": 0.0, "north_m_s": 0.0}


NAMED = f"name='a'\nscenario='{FAKE}:FakeScenario'\n"
#: Texts of a table of a campaign file (or option), and the message.
INVALID = {
    "parameters": [
        ("altitud_m = 3", "parameters.altitud_m: unknown key (did you mean 'altitude_m'?); allowed: aborting"),
        ("wind = {est_m_s = 3}", "parameters.wind.est_m_s: unknown key (did you mean 'east_m_s'?); allowed: east"),
        ("altitude_m = -10", "parameters.altitude_m: input should be greater than 0, got -10"),
        ("altitude_m = 'high'", "parameters.altitude_m: input should be a valid number"),
        ("heights_m = [1]", "parameters.heights_m[1]: required, but missing"),
        ("lowest_altitude_m = 2100.0", "parameters: altitude_m must be above lowest_altitude_m"),
        ("wind = 3", "parameters.wind: input should be a valid dictionary"),
    ],
    "dispersions": [
        ("altitud_m = {distribution='uniform', low=1, high=2}", "dispersions.altitud_m: unknown parameter 'altitud_m'"),
        ("wind = {distribution='uniform', low=1, high=2}", "dispersions.wind: is a table; disperse one of its values"),
        ("altitude_m = {distribution='unifrom', low=1, high=2}", "(did you mean 'uniform'?); allowed: uniform, normal"),
        ("altitude_m = {distribution='uniform', low=1, hgh=2}", "altitude_m.hgh: unknown key (did you mean 'high'?)"),
        ("altitude_m = {distribution='uniform', low=1}", "dispersions.altitude_m.high: required, but missing"),
        ("altitude_m = {distribution='uniform', low=2, high=1}", "low = 2.0 must be below high = 1.0"),
        ("altitude_m = {distribution='uniform', low=nan, high=1}", "altitude_m.low: input should be a finite number"),
        ("altitude_m = {distribution='uniform', low=true, high=1}", "altitude_m.low: input should be a valid number"),
        ("altitude_m = {distribution='normal', mean=5, sd=0}", "altitude_m.sd: input should be greater than 0"),
        (
            "altitude_m = {distribution='normal', mean=5, sd=1, truncate=[9,8]}",
            "truncate = [9.0, 8.0]: the first limit must be below",
        ),
        ("altitude_m = {distribution='normal', mean=5, sd=1, truncate=[90,95]}", "no probability between the limits"),
        ("altitude_m = {distribution='normal', mean=500, sd=100}", "which is not valid: altitude_m"),
        ("altitude_m = {distribution='cauchy', loc=2000}", "which is not valid"),
        ("altitude_m = {distribution='gamma', scale=2}", "parameter 'a' is missing; gamma accepts a, loc, scale"),
        ("altitude_m = {distribution='gamma', a=1, scal=2}", "unknown parameter 'scal' (did you mean 'scale'?)"),
        ("altitude_m = {distribution='gamma', a=-1}", "gamma is not defined for a = -1.0"),
        ("altitude_m = {distribution='gamma', a='x'}", "altitude_m.a: unknown parameter 'x'; allowed: aborting_cases"),
        ("altitude_m = {distribution='gamma', a=[1]}", "altitude_m.a: input should be a valid number"),
        (
            "'wind.east_m_s' = {distribution='poisson', mu=1e300}",
            '"wind.east_m_s": poisson is not defined for mu = 1e+300',
        ),
        ("altitude_m = 'uniform'", "dispersions.altitude_m: input should be a valid dictionary"),
        ("altitude_m = {low = 1}", "dispersions.altitude_m.distribution: required, but missing"),
        ("terrain = {distribution='integer', low=0, high=100000}", "includes 100000, which is not valid"),
        ("terrain = {distribution='integer', low=0.5, high=2}", "terrain.low: input should be a valid integer"),
        ("terrain = {distribution='integer', low=3, high=2}", "low = 3 must not be above high = 2"),
        ("terrain = {distribution='uniform', low=0, high=3}", "input should be a valid integer"),
        ("wind = {distribution='choice', values=[{}, {est_m_s=3}]}", "which is not valid: wind.est_m_s: unknown key"),
        ("wind = {distribution='choice', values=[{}, 3]}", "includes 3, which is not valid"),
        ("kind = {distribution='choice', values=['a', 'B']}", "includes 'B', which is not valid"),
        ("kind = {distribution='choice', values=['a'], weights=[1, 2]}", "2 weights for 1 values"),
        ("kind = {distribution='choice', values=[]}", "kind.values: list should have at least 1 item"),
        ("kind = {distribution='choice', values=['a'], weights=[0]}", "kind.weights[0]: input should be greater"),
    ],
    "top_level_keys": [
        ("name='a'\nscenario='descnt'\ncases=1", "unknown scenario 'descnt' (did you mean 'descent'?)"),
        ("name='a'\nscenario='no_such_module:X'\ncases=1", "cannot import scenario 'no_such_module:X': No module"),
        (f"name='a'\nscenario='{FAKE}:Wind'\ncases=1", "is not a valid scenario: missing members: parameters_type"),
        (f"name='a b'\nscenario='{FAKE}:FakeScenario'\ncases=1", "name: string should match pattern"),
        (f"scenario='{FAKE}:FakeScenario'\ncases=1", "name: required, but missing"),
        (NAMED + "cases=0", "cases: input should be greater"),
        (NAMED + "cases=true", "cases: input should be a valid integer"),
        (NAMED + "cases=1\nseed=-1", "seed: input should be greater than or"),
        (NAMED + "cases=1\nsed=1", "sed: unknown key (did you mean 'seed'?)"),
        (NAMED + "cases=1\nx=", "not valid TOML"),
    ],
    "requirement": [
        ("bound = 'x'", "requirements[0].bound: input should be a valid number, got 'x'"),
        ("bound = inf", "requirements[0].bound: input should be a finite number"),
        ("probability = 1.0", "requirements[0].probability: input should be less than 1, got 1.0"),
        ("confidence = 90", "requirements[0].confidence: input should be less than 1, got 90"),
        ("population = 'valid or not'", "requirements[0].population: string should match pattern"),
        ("decide_by = 'luck'", "requirements[0].decide_by: input should be 'confidence' or 'estimate', got 'luck'"),
        ("metrik = 'x'", "requirements[0].metrik: unknown key (did you mean 'metric'?); allowed: accept_rate, bound"),
        ("accept_rate = true", 'accept_rate needs decide_by = "estimate"'),
    ],
    "--set": [
        ("altitude_m=-3", "parameters.altitude_m: input should be greater than 0, got -3"),
        ("altitud_m=3", "parameters.altitud_m: unknown key (did you mean 'altitude_m'?)"),
        ("cases=many", "cases: input should be a valid integer, got 'many'"),
        ("wind=3", "parameters.wind: input should be a valid dictionary"),
        ("wind.east_m_s.x=3", "parameters.wind.east_m_s: input should be a valid number"),
        ("altitude_m", "expected KEY=VALUE"),
        ("=3", "expected KEY=VALUE"),
        ("a b=3", "is not a dotted key"),
        ("a..b=3", "is not a dotted key"),
        ("a=1\nb=2", "expected KEY=VALUE"),
        ("dispersions.terrain.high=100000", "dispersions.terrain: integer(low=0, high=100000) includes 100000"),
    ],
}


@pytest.mark.parametrize(
    ("table", "text", "message"), [(table, *entry) for table, entries in INVALID.items() for entry in entries]
)
def test_invalid_values_are_reported(campaign_file: CampaignFile, table: str, text: str, message: str) -> None:
    texts = {table: text} | ({"dispersions": ""} if table == "parameters" else {})
    if table == "dispersions":
        texts = {table: f"[dispersions]\n{text}"}
    elif table == "requirement":
        values = {"id": "'a'", "metric": "'m'", "bound": "1", "probability": "0.9", "confidence": "0.9"}
        lines = [f"{key} = {value}" for key, value in values.items() if key != text.split(" ")[0]]
        texts = {table: "\n".join(["[[requirements]]", *lines, text])}
    overrides = [texts.pop("--set")] if table == "--set" else []
    path = campaign_file(**texts)
    error = load_and_expect_error(path, *overrides)
    start = {"dispersions": f"{path}: dispersions.", "--set": f"--set {text}: ".replace("\n", "\\n")}
    assert error.startswith(start.get(table, f"{path}: "))
    assert message in error


def test_draws_with_invalid_combinations_are_reported(campaign_file: CampaignFile) -> None:
    dispersions = '[dispersions]\naltitude_m = {distribution = "uniform", low = 1000, high = 2000}'
    text = load_and_expect_error(campaign_file("altitude_m = 2000\nlowest_altitude_m = 1500", dispersions=dispersions))
    assert "altitude_m must be above lowest_altitude_m" in text


def test_duplicate_requirement_ids_are_rejected(campaign_file: CampaignFile) -> None:
    entry = "[[requirements]]\nid='a'\nmetric='m'\nbound=1\nprobability=0.9\nconfidence=0.9\n"
    assert "requirements share an id: a" in load_and_expect_error(campaign_file(requirement=entry + entry))


def test_all_problems_are_listed_together(campaign_file: CampaignFile) -> None:
    path = campaign_file(
        "altitude_m = -1\nwnd = 3", extra_tables="[retain]\nshowcase = 'best'", dispersions="[dispersions]\nkind = 3"
    )
    with pytest.raises(DefinitionError) as error:
        load_campaign(str(path), [], cases=0)
    keys = {problem.key for problem in error.value.problems}
    assert keys == {"cases", "parameters.altitude_m", "parameters.wnd", "retain.showcase", "dispersions.kind"}


def test_missing_files_are_reported(tmp_path: Path) -> None:
    assert load_and_expect_error(tmp_path / "no.toml") == f"{tmp_path / 'no.toml'}: no such file"
    assert load_and_expect_error(tmp_path) == f"{tmp_path}: is a folder"
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    assert "not valid TOML" in load_and_expect_error(tmp_path / "bytes.toml")
    (tmp_path / "deep.toml").write_text("x = " + "[" * 100_000)
    assert "not valid TOML" in load_and_expect_error(tmp_path / "deep.toml")


def test_unknown_campaign_error_lists_known_campaigns() -> None:
    text = load_and_expect_error("dimes-smok")
    assert "unknown campaign 'dimes-smok'" in text
    assert "path of a TOML file" in text
    for name in catalogue():
        assert name in text


def test_documented_sampling_example_can_be_loaded(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "sampling.md").read_text()
    example = text.partition("```toml\n")[2].partition("```")[0]
    path = tmp_path / "example.toml"
    path.write_text(f"name = 'example'\nscenario = 'descent'\ncases = 41\n{example}")
    campaign = load_campaign(str(path))
    assert [campaign.draws(case)["descent.altitude_first_m"] for case in (1, 2, 40)] == [1400.0, 1700.0, 2600.0]


def test_overrides_replace_values_and_dispersions(campaign_file: CampaignFile) -> None:
    path = str(campaign_file())
    overrides = ["altitude_m=1500", "wind.east_m_s = 3", "kind=smooth", "retain.showcase=none", "heights_m=[3, 4.5]"]
    definition = load_campaign(path, overrides, cases=7, seed=9).definition
    assert (definition.cases, definition.seed, definition.retain.showcase) == (7, 9, "none")
    assert definition.parameters["altitude_m"] == 1500.0
    assert definition.parameters["kind"] == "smooth"
    assert definition.parameters["heights_m"] == [3.0, 4.5]
    # setting a parameter removes its dispersion
    assert set(definition.dispersions) == {"terrain"}
    overrides = ['dispersions."wind.east_m_s".low=-5', "cases=3", "parameters.kind=x"]
    changed_definition = load_campaign(path, overrides).definition
    assert changed_definition.dispersions["wind.east_m_s"].quantile(1e-9) == pytest.approx(-5.0)
    assert changed_definition.cases == 3


#: Words of valid and invalid keys and values for random campaign files.
_WORDS = """
name scenario cases seed parameters dispersions requirements retain wind altitude_m wind.east_m_s distribution uniform
low high choice values truncate norm gamma id
"""
_random_words = st.sampled_from(_WORDS.split())


_random_values = st.recursive(
    st.booleans() | st.integers(-(10**6), 10**6) | st.floats() | _random_words,
    lambda elements: st.lists(elements, max_size=3) | st.dictionaries(_random_words, elements, max_size=4),
    max_leaves=8,
)


@given(changes=st.dictionaries(_random_words, _random_values, min_size=1, max_size=3))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_files_are_loaded_or_their_keys_reported(tmp_path: Path, changes: dict[str, object]) -> None:
    base: dict[str, object] = {"name": "fake", "scenario": "tests.campaigns.fake_scenario:FakeScenario", "cases": 3}
    text = "\n".join(f"{to_toml(key)} = {to_toml(value)}" for key, value in {**base, **changes}.items())
    path = tmp_path / "random.toml"
    path.write_text(text)
    tomllib.loads(text)
    assert all(find_error_keys(lambda: load_campaign(str(path))))


def find_error_keys(load: Callable[[], object]) -> list[str]:
    """Return one key per reported problem; empty if the campaign loads."""
    try:
        load()
    except DefinitionError as error:
        return [problem.key for problem in error.problems]
    return []


#: Values of a valid campaign, by table.
_VALID_TABLES: dict[str, dict[str, object]] = {
    "limits": {"case_time_s": 10.0, "memory_gb": 1.0, "output_mb": 1.0},
    "retain": {"products": "worst", "worst": 2, "budget_gb": 1.0},
    "design": {"kind": "random", "nominal": True},
    "requirements": {"id": "'v'", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.9, "confidence": 0.9},
    "parameters": {"altitude_m": 1900.0, "terrain": 2, "kind": "plain", "heights_m": [1.0, 2.0]},
}


@given(
    table_and_key=st.sampled_from([(table, key) for table, entries in _VALID_TABLES.items() for key in entries]),
    value=_random_values,
    is_removed=st.booleans(),
)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_invalid_value_is_reported_by_its_key(
    tmp_path: Path, table_and_key: tuple[str, str], value: object, is_removed: bool
) -> None:
    table, key = table_and_key
    tables = {name: dict(entries) for name, entries in _VALID_TABLES.items()}
    tables[table].pop(key) if is_removed else tables[table].update({key: value})
    top_level_keys = 'name = "fake"\nscenario = "tests.campaigns.fake_scenario:FakeScenario"\ncases = 12\n'
    lines = [
        f"{name} = {to_toml([entries] if name == 'requirements' else entries)}" for name, entries in tables.items()
    ]
    path = tmp_path / "invalid.toml"
    path.write_text(top_level_keys + "\n".join(lines))
    reported_keys = find_error_keys(lambda: load_campaign(str(path)))
    # an invalid table is reported by the name of the table
    assert all(reported_key.startswith(table) for reported_key in reported_keys), reported_keys
    # no key accepts a table as value; a requirement needs metric and probability
    is_invalid = key in ("metric", "probability") if is_removed else isinstance(value, dict)
    assert reported_keys or not is_invalid


@given(override=st.text(max_size=20) | st.builds("{}={}".format, _random_words, st.text(max_size=8)))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_overrides_raise_only_definition_errors(campaign_file: CampaignFile, override: str) -> None:
    with contextlib.suppress(DefinitionError):
        load_campaign(str(campaign_file()), [override])


def test_drawn_table_uses_defaults_for_omitted_keys(campaign_file: CampaignFile) -> None:
    """Omitted keys of a drawn table take their defaults, not the campaign's parameters."""
    choice = "[dispersions]\nwind = {distribution='choice', values=[{}, {east_m_s=3}, {north_m_s=-4, east_m_s=5}]}"
    path = str(campaign_file("wind = {north_m_s = 20}", dispersions=choice))
    campaign = load_campaign(path)
    winds = {tuple(campaign.parameters(case).wind.model_dump().values()) for case in range(40)}  # type: ignore[attr-defined]
    assert winds == {(0.0, 0.0), (3.0, 0.0), (5.0, -4.0)}
    # setting a value of the table removes the dispersion of the table
    campaign_with_fixed_wind = load_campaign(path, ["wind.east_m_s=7"])
    assert campaign_with_fixed_wind.definition.dispersions == {}


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("wnd.est_m_s", "aborting_cases, allocating_cases, altitude_m, "),
        ("wind.est_m_s", "wind.east_m_s, wind.north_m_s"),
        ("wind.east_m_s.x", "wind.east_m_s, wind.north_m_s"),
    ],
)
def test_unknown_parameter_error_lists_keys_of_its_table(campaign_file: CampaignFile, path: str, allowed: str) -> None:
    """Only the keys of the innermost existing table are listed."""
    dispersion = f'[dispersions]\n"{path}" = {{distribution="uniform", low=1, high=2}}'
    text = load_and_expect_error(campaign_file(dispersions=dispersion))
    assert f"allowed: {allowed}" in text
    assert ("wind.*" in text) == path.startswith("wnd")


def test_hash_of_the_code_includes_the_shaders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.campaigns.definition.identity.hash_sources", lambda sources: sorted(dict(sources)))
    names = hash_code.__wrapped__(())
    assert {"sim/render/pinhole.py", "sim/render/shaders/segmentation.vert"} <= set(names)


@pytest.mark.parametrize(
    ("campaign", "path", "value"),
    [
        ("dimes-smoke", "algorithm", "custom:Estimator"),
        ("dimes-smoke", "compared", ["custom:Estimator"]),
        ("dimes-smoke", "compared.0", "custom:Estimator"),
        ("vtt-sideways", "drive", {"algorithm": "custom:Estimator"}),
        ("vtt-sideways", "drive", {"compared": ["custom:Estimator"]}),
    ],
)
def test_algorithms_in_dispersions_are_listed(campaign: str, path: str, value: object) -> None:
    """Otherwise the code of a folder from elsewhere would be executed without --trust, and would have no hash."""
    tables = load_campaign(campaign).definition.model_dump(mode="json")
    tables |= {"correlations": [], "dispersions": {path: {"distribution": "choice", "values": [value]}}}
    assert list_algorithms(CampaignDefinition.model_validate(tables))[-1] == "custom:Estimator"


@pytest.mark.parametrize("path", ["location.bank_seed", "location"])
def test_dispersed_seed_of_a_terrain_bank_is_not_derived(path: str) -> None:
    """The command of a confirmation sets derived seeds, which removes their dispersions."""
    definition = load_campaign("dimes-smoke").definition
    assert set(bank_seeds(definition)) == {"location.bank_seed"}
    value = {"bank_seed": 5} if path == "location" else 5
    tables = definition.model_dump(mode="json")
    tables |= {"correlations": [], "dispersions": {path: {"distribution": "fixed", "value": value}}}
    assert bank_seeds(CampaignDefinition.model_validate(tables)) == {}
