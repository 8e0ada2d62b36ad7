"""Tests of `marsyard robust`: cases of a run with other parameters, verdicts of variants, report, and errors.

The limit state fails if beta - u < 0 for a standard normal u: the rate is Phi(-beta).
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm
from typer.testing import CliRunner

import marsyard
from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.variants import SystemVariant, system_variants
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.sampling.study_points import StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.studies.results import RobustVariant
from marsyard.campaigns.studies.robust import _check_values, choose_cases, start_robust
from marsyard.cli.app import app
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.robustness import ChangeOutcome
from marsyard.reports.robustness_section import variant_grid
from marsyard.reports.robustness_wording import reach_text
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.variants import RobustStudy, _evaluate, _find_step
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.scenarios.systems import catalogue
from marsyard.sim.terrain import Site
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows
from tests.campaigns.studies.limit_state import CAMPAIGN
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()
#: Beta of the runs: 0.6 % of the cases fail, of at most 5 %.
CAMPAIGN = CAMPAIGN.replace("cases = 100", "cases = 200").replace("probability = 0.99", "probability = 0.95")
BETA = 2.5


def run_text(folder: Path, text: str, cases: int, *overrides: str) -> Path:
    """Run a campaign with this text; return its folder."""
    (folder / "campaign.toml").write_text(text)
    campaign = load_campaign(str(folder / "campaign.toml"), overrides, cases)
    run_campaign(campaign, folder / "run", ExecutorConfig(1), RecordingWatch())
    return folder / "run"


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the limit state; return its folder, which tests must copy."""
    return run_text(tmp_path_factory.mktemp("robust"), CAMPAIGN, 200, f"beta={BETA}")


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def study(run: Path, farthest: Mapping[str, float], variants: tuple[SystemVariant, ...] = (), cases: int = 200) -> Path:
    directory = run / "robust" / "study"
    start_robust(run, farthest, variants, cases, directory, ExecutorConfig(1), RecordingWatch())
    return directory


def test_change_of_a_fixed_parameter(run: Path) -> None:
    """All cases run at three values of beta; the change to FAIL is that at which 5 % of the run's cases fail."""
    directory = study(run, {"beta": 1.0})
    rows, base = read_case_rows(directory), read_case_rows(run)
    assert len(rows) == 600
    # the same dispersions and noise: only beta differs, in steps of 0.5
    for case in (0, 1, 199):
        repeated = [row["load"] for row in rows[3 * case : 3 * case + 3]]
        assert repeated == pytest.approx([base[case]["load"] + step for step in (0.5, 1.0, 1.5)], abs=1e-9)
    assert StudyPoint.read(rows[0]["standard_point"]).values == (("beta", 2.0),)
    assert replay(directory, 4).differing == ()

    evaluation = evaluate_run(run)
    item = next(item for item in evaluation.robustness if item.kind is ChangeKind.VALUE and item.requirement == "LOAD")
    loads = np.sort([row["load"] for row in base])[::-1]
    exact = 100.0 - loads[10]  # decrease of beta at which 11 of 200 cases fail, more than 5 %
    assert item.outcome is ChangeOutcome.FOUND
    assert item.assumed - item.fails_at == pytest.approx(exact, abs=0.05)
    assert item.lower < item.change < item.upper
    assert item.passes_at == pytest.approx(BETA * (1.0 - item.lower))
    assert (item.unit, item.spread, item.assumed) == ("", BETA, BETA)


def test_dashboard_states_how_far_a_verdict_reaches(run: Path, tmp_path: Path) -> None:
    """Index, its data for the filters, and the campaign's page contain the smallest change that loses the PASS."""
    site = tmp_path / "site"
    assert write_site(site, [run]).problems == []
    evaluation = evaluate_run(run)
    texts = [reach_text(verdict, evaluation.robustness) for verdict in evaluation.verdicts]
    text = texts[0]
    assert text.startswith("holds up to 0.")
    assert (site / "index.html").read_text().count(text) == 2 * texts.count(text)
    assert text in next((site / "c").glob("*/index.html")).read_text()


def test_choice_of_cases_represents_all_cases() -> None:
    """Half of the cases are the nearest to a violation; the weights add up to the number of cases of the run."""
    requirement = Requirement.model_validate(
        {"id": "LOAD", "metric": "load", "bound": 100.0, "probability": 0.95, "confidence": 0.9}
    )
    loads = np.random.default_rng(3).normal(98.0, 1.0, 500)
    rows = [{"case": case, "outcome": "VALID", "answered": True, "load": load} for case, load in enumerate(loads)]
    chosen, weights = choose_cases(rows, [requirement], 80, np.random.default_rng(1))
    nearest = set(np.argsort(-loads)[:40].tolist())
    assert set(chosen[weights == 1.0].tolist()) == nearest
    assert weights.sum() == pytest.approx(500.0)
    assert (np.diff(chosen) > 0).all()
    # cases that only violate or not: the violations are chosen
    flag = Requirement.model_validate({"id": "F", "metric": "ok", "probability": 0.95, "confidence": 0.9})
    for row in rows:
        row["ok"] = row["case"] not in (400, 450)
    chosen, weights = choose_cases(rows, [requirement, flag], 80, np.random.default_rng(1))
    assert {400, 450} <= set(chosen[weights == 1.0].tolist())
    assert len(nearest & set(chosen[weights == 1.0].tolist())) >= 38
    everything, ones = choose_cases(rows, [requirement], 500, np.random.default_rng(1))
    assert (everything == np.arange(500)).all()
    assert (ones == 1.0).all()


def test_interval_of_few_cases_covers_the_change() -> None:
    """100 of 600 cases run in three steps of beta: FAIL is shown too early in at most 10 % of 200 samples (SD 2.1 %).

    The cases are too few for PASS, which is therefore not claimed.
    """
    verdict = Verdict("LOAD", "", "load", 100.0, 0.97, 0.9, "all")
    requirement = Requirement.model_validate(
        {"id": "LOAD", "metric": "load", "bound": 100.0, "probability": 0.97, "confidence": 0.9}
    )
    rng, values = np.random.default_rng(5), [2.4, 1.9, 1.4, 0.9]
    exact = (2.4 - norm.isf(0.03)) / 2.4
    records = []
    for _ in range(200):
        u = rng.standard_normal(600)
        loads = 100.0 - 2.4 + u
        rows = [{"case": case, "outcome": "VALID", "answered": True, "load": load} for case, load in enumerate(loads)]
        chosen, weights = choose_cases(rows, [requirement], 100, rng)
        margins = np.array([value - u[chosen] for value in values])
        cases = RobustStudy([], pd.DataFrame({"case": chosen}), weights)
        records.append(_find_step(cases, verdict, "beta", values, margins))
    assert np.mean([item.upper >= exact for item in records]) >= 0.9 - 2.5 * 0.021
    assert np.median([item.change for item in records]) == pytest.approx(exact, rel=0.1)
    assert all(math.isnan(item.lower) for item in records)


def test_bounds_of_variants_allow_for_shared_terrains_and_repeated_looks() -> None:
    """Pairs of failures on 100 terrains: the bounds are those of a verdict, at the confidence of its look."""
    rows = pd.DataFrame({"case": np.arange(300), "outcome": "VALID", "answered": True, "ok": np.arange(300) >= 8})
    rows["terrain"] = np.arange(300) // 3
    verdict = Verdict("OK", "", "ok", math.nan, 0.95, 0.9, "all", bounds_confidence=0.95, upper_confidence=0.97)
    study = RobustStudy([], rows, np.ones(300))
    result = _evaluate(study, RobustVariant("v", "V", {}), rows, verdict)
    exact = ClusteredCases.of(rows["ok"].to_numpy(), rows["terrain"].to_numpy())
    assert result is not None
    assert result.upper == pytest.approx(exact.max_failure_rate(0.05), rel=1e-3)
    assert 0.0 < result.lower <= exact.min_failure_rate(0.03) * 1.001


def test_variant_with_exactly_the_required_rate_is_met_by_rate() -> None:
    """1 - 0.9 is a little less than 10 of 100."""
    rows = pd.DataFrame({"case": np.arange(100), "outcome": "VALID", "answered": True, "ok": np.arange(100) >= 10})
    verdict = Verdict("OK", "", "ok", math.nan, 0.9, 0.9, "all", decide_by=ESTIMATE)
    result = _evaluate(RobustStudy([], rows, np.ones(100)), RobustVariant("v", "V", {}), rows, verdict)
    assert result is not None
    assert result.status is Status.MET_BY_RATE


def test_steps_allow_for_shared_terrains() -> None:
    """Pairs of failures on 100 terrains widen the interval of the change, as they widen the bounds of a verdict."""
    margins = np.array([np.where(np.arange(300) < failures, -1.0, 1.0) for failures in (4, 40)])
    verdict = Verdict("OK", "", "ok", math.nan, 0.9, 0.9, "all")
    crossings = []
    for terrain in (np.arange(300), np.arange(300) // 3):
        rows = pd.DataFrame({"case": np.arange(300), "terrain": terrain})
        crossings.append(_find_step(RobustStudy([], rows, np.ones(300)), verdict, "beta", [1.0, 2.0], margins))
    single, shared = crossings
    assert shared.lower < single.lower
    assert not shared.upper <= single.upper


VARIANTS = (
    SystemVariant(name="noisy", title="twice the noise", values={"noise": 0.5}, source="test"),
    SystemVariant(name="weak", title="a lower limit", factors={"beta": 0.3}, source="test"),
    SystemVariant(name="same", title="the values of the campaign", values={"beta": BETA}, source="test"),
    SystemVariant(name="missing", title="another system", values={"height_m": 1.0}, source="test"),
)


def test_verdicts_of_variants(run: Path) -> None:
    """A variant with the values of the campaign, or with unknown parameters, does not run."""
    study(run, {}, VARIANTS)
    evaluation = evaluate_run(run)
    verdicts = {(item.variant, item.requirement): item for item in evaluation.variants}
    assert {name for name, _ in verdicts} == {"as assumed", "noisy", "weak"}
    assert verdicts["as assumed", "LOAD"].status is Status.PASS
    assert verdicts["noisy", "LOAD"].status is Status.PASS  # the rate does not depend on the noise
    weak = verdicts["weak", "LOAD"]
    assert weak.status is Status.FAIL
    assert weak.lower < norm.cdf(-0.3 * BETA) < weak.upper
    # with all cases, the bounds are those of the verdict
    assert 1.0 - verdicts["as assumed", "LOAD"].upper == pytest.approx(evaluation.verdicts[0].lower, abs=1e-6)
    # the program changed during the run: nothing can be PASS
    record.update(run, {"changes": [{"in": ["code"]}]})
    statuses = {(item.variant, item.requirement): item.status for item in evaluate_run(run).variants}
    assert statuses["as assumed", "LOAD"] is Status.INSUFFICIENT
    assert statuses["weak", "LOAD"] is Status.FAIL


@pytest.mark.parametrize(
    "dispersion",
    [
        '"fixed", value = 3.0',
        '"derived", formula = "3.0 + 0.0 * noise"',
        '"uniform", low = 2.0, high = 4.0',
        '"choice", values = [2.0, 4.0]',
    ],
)
def test_factor_of_a_variant_scales_the_value_of_each_case(tmp_path: Path, dispersion: str) -> None:
    """Half of the value of `beta` in each case, however the campaign sets it; a value replaces it in all cases."""
    text = CAMPAIGN.replace("[dispersions]", f"[dispersions]\nbeta = {{ distribution = {dispersion} }}")
    run = run_text(tmp_path, text, 60)
    factor = SystemVariant(name="half", title="half", factors={"beta": 0.5}, source="test")
    value = SystemVariant(name="value", title="the campaign's parameter", values={"beta": 3.0}, source="test")
    rows, base = read_case_rows(study(run, {}, (factor, value), 60)), read_case_rows(run)
    for half, same, stored in zip(rows[::2], rows[1::2], base, strict=True):
        assert half["beta"] == pytest.approx(0.5 * stored["beta"])
        assert half["load"] == pytest.approx(stored["load"] + 0.5 * stored["beta"])
        assert same["load"] == pytest.approx(stored["load"] + stored["beta"] - 3.0)


def test_values_that_the_scenario_rejects_in_a_case_are_found_before_the_first(tmp_path: Path) -> None:
    variant = SystemVariant(name="broken", title="half a terrain", factors={"terrain": 0.5}, source="test")
    terrain = '[dispersions]\nterrain = { distribution = "integer", low = 0, high = 7 }'
    run = run_text(tmp_path, CAMPAIGN.replace("[dispersions]", terrain), 60)
    with pytest.raises(CampaignError, match=r"broken: .* \(case \d+\)"):
        study(run, {}, (variant,), 60)


def test_each_study_has_its_own_row_as_assumed(run: Path) -> None:
    """Variants are compared with the same cases under the campaign's values, also if studies have other cases."""
    for name, cases, variant in (("a", 60, VARIANTS[0]), ("b", 200, VARIANTS[1])):
        start_robust(run, {}, (variant,), cases, run / "robust" / name, ExecutorConfig(1), RecordingWatch())
    grid, _ = variant_grid(evaluate_run(run).variants)
    titles = [row[0] for row in grid.rows]
    assert titles == [
        "the campaign's own values, 60 cases",
        "twice the noise, 60 cases",
        "the campaign's own values, 200 cases",
        "a lower limit, 200 cases",
    ]


def test_command_writes_report_and_table(run: Path) -> None:
    arguments = ["robust", str(run), "--parameter", "beta=1.0", "-n", "60", "--jobs", "1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "Change to FAIL: LOAD" in result.output
    assert "LOAD: PASS holds (90 % confidence, one change at a time) " in result.output
    assert "on average): beta " in result.output
    data = json.loads((run / "report.json").read_text())
    record_ = next(item for item in data["robustness"] if item["kind"] == "value" and item["requirement"] == "LOAD")
    keys = {"requirement", "parameter", "unit", "assumed", "spread", "change", "lower", "upper", "effective_cases"}
    assert keys | {"outcome", "reach", "pass_text", "fail_text"} <= set(record_)
    assert (record_["parameter"], record_["outcome"]) == ("beta", "found")
    assert record_["effective_cases"] == pytest.approx(200.0**2 / (30.0 + 30.0 * (170.0 / 30.0) ** 2), rel=1e-6)
    page = (run / "report.html").read_text()
    for text in ("How far the verdicts reach", "Change to FAIL: LOAD", "PASS holds (90 % confidence"):
        assert text in page
    table = marsyard.open_result(run).robustness()
    assert {"change", "lower", "upper", "outcome", "text"} <= set(table.columns)
    assert len(table.loc["LOAD"]) == len([item for item in data["robustness"] if item["requirement"] == "LOAD"])


def test_run_shows_robustness_without_a_study(run: Path) -> None:
    result = CliRunner().invoke(app, ["report", str(run)])
    assert "robustness of LOAD: PASS holds (90 % confidence, one change at a time) " in result.output
    assert not (run / "robust").exists()


def test_interrupted_study_resumes_with_the_same_rows(run: Path, tmp_path: Path) -> None:
    whole = study(run, {"beta": 1.0}, cases=60)
    reference = read_case_rows(whole)
    partial = Path(shutil.copytree(whole, tmp_path / "partial"))

    class Interruption(RecordingWatch):
        def step(self) -> None:
            super().step()
            if self.steps["cases"] == 50:
                raise KeyboardInterrupt

    shutil.rmtree(whole)
    shutil.rmtree(partial)
    with pytest.raises(KeyboardInterrupt):
        start_robust(run, {"beta": 1.0}, (), 60, whole, ExecutorConfig(1), Interruption())
    assert not any(item.kind is ChangeKind.VALUE for item in evaluate_run(run).robustness)
    result = CliRunner().invoke(app, ["resume", str(whole), "--jobs", "1"])
    assert result.exit_code == 0, result.output
    times = ("wall_time_s", "cpu_time_s")
    assert [{k: v for k, v in row.items() if k not in times} for row in read_case_rows(whole)] == [
        {k: v for k, v in row.items() if k not in times} for row in reference
    ]
    assert "on average): beta " in result.output


def test_changed_rows_of_a_study_are_found(run: Path) -> None:
    directory = study(run, {"beta": 1.0}, cases=60)
    frame = pd.read_parquet(directory / "cases.parquet")
    frame.loc[0, "load"] = 0.0
    frame.to_parquet(directory / "cases.parquet")
    with pytest.raises(StoreError, match="was changed"):
        evaluate_run(run).robustness  # noqa: B018


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parameter", "loads.0=3"), "is dispersed, so that the stored cases give its robustness"),
        (("--parameter", "betta=1"), "there is no parameter 'betta'"),
        (("--parameter", "terrain=2.5"), "its value in the campaign is -1; allowed: whole numbers"),
        (("--parameter", "step=1"), "is False; allowed: parameters with a number"),
        (("--parameter", f"beta={BETA}"), "this is its value in the campaign"),
        (("--parameter", "beta=1", "-n", "20"), "--cases 20: at least 60"),
        (("--variant", "all"), "LimitStateScenario' has no variants"),
        *(
            (("--parameter", text), f"--parameter {text}: allowed: PATH=NUMBER")
            for text in ("beta", "beta=", "beta=two", "beta=nan")
        ),
    ],
)
def test_unsuitable_options_are_rejected(finished_run: Path, arguments: tuple[str, ...], message: str) -> None:
    result = CliRunner().invoke(app, ["robust", str(finished_run), *arguments])
    assert (result.exit_code, message in " ".join(result.output.split())) == (2, True), result.output
    assert not (finished_run / "robust").exists()


@pytest.mark.parametrize("dispersion", ['"fixed", value = 2.0', '"derived", formula = "2.0"'])
def test_value_that_the_campaign_sets_by_a_dispersion_is_rejected(tmp_path: Path, dispersion: str) -> None:
    text = CAMPAIGN.replace("[dispersions]", f"[dispersions]\nbeta = {{ distribution = {dispersion} }}")
    result = CliRunner().invoke(app, ["robust", str(run_text(tmp_path, text, 2)), "--parameter", "beta=1"])
    distribution = dispersion.split(",")[0].strip('"')
    message = f"--parameter beta=1: dispersions.beta of the campaign is '{distribution}'; allowed: parameters without"
    assert (result.exit_code, message in " ".join(result.output.split())) == (2, True), result.output


def test_nominal_case_is_not_repeated(tmp_path: Path) -> None:
    """It is no random draw: the study has the 60 cases after it."""
    run = run_text(tmp_path, f"{CAMPAIGN}\n[design]\nnominal = true\n", 61)
    rows = read_case_rows(study(run, {"beta": 1.0}, cases=60))
    assert {StudyPoint.read(row["standard_point"]).stream for row in rows} == set(range(1, 61))


def test_value_in_a_dispersed_table_is_rejected(tmp_path: Path) -> None:
    lines = [line for line in CAMPAIGN.splitlines() if not line.startswith('"loads.')]
    table = 'loads = { distribution = "choice", values = [[0.0, 0.0], [1.0, 1.0]] }'
    lines.insert(lines.index("[dispersions]") + 1, table)
    run = run_text(tmp_path, "\n".join(lines), 2)
    with pytest.raises(CampaignError, match=r"loads\.0 = .*: its table 'loads' is dispersed as a whole"):
        study(run, {"loads.0": 3.0})


def test_invalid_value_of_a_variant_is_rejected(run: Path) -> None:
    variant = SystemVariant(name="invalid", title="a number as name", values={"kind": 5}, source="test")
    with pytest.raises(CampaignError, match="invalid: Input should be a valid string"):
        study(run, {}, (variant,))


def test_unfinished_run_is_rejected(run: Path) -> None:
    record.update(run, {"state": "interrupted"})
    with pytest.raises(CampaignError, match="it is not finished"):
        study(run, {"beta": 1.0})


def test_study_is_no_run(run: Path) -> None:
    directory = study(run, {"beta": 1.0}, cases=60)
    with pytest.raises(CampaignError, match="its cases are not independent random draws"):
        study(directory, {"beta": 1.0})


def test_variants_of_the_included_systems_are_valid() -> None:
    """Each system has variants of detector, photometry and terrain, and the scenario accepts their values."""
    kinds: dict[str, set[str]] = {}
    for name in catalogue():
        campaign = load_campaign(name)
        for variant in system_variants(campaign.definition.scenario):
            values, factors = variant.changes(campaign)
            if values or factors:
                _check_values(campaign, RobustVariant(variant.name, variant.title, values, factors=factors), range(3))
                kinds.setdefault(campaign.definition.scenario, set()).add(variant.name.partition("-")[0])
    for scenario in ("descent", "landing", "localisation", "rover"):
        assert {"photometry", "terrain"} <= kinds[scenario]
        assert {"residuals", "detector"} & kinds[scenario]


@pytest.mark.parametrize(
    ("campaign_name", "table", "find_site"),
    [
        ("dimes-gusev", "photometry", lambda parameters: parameters.site_preset),
        ("hda-mars", "photometry", lambda parameters: parameters.site_preset),
        ("loc-jezero", "photometry", lambda parameters: parameters.site_preset),
        ("vtt-montecarlo", "world.photometry", lambda parameters: parameters.world.lit_site),
    ],
)
def test_photometry_of_a_variant_reaches_the_site(
    campaign_name: str, table: str, find_site: Callable[[Any], Site]
) -> None:
    """The law changes, the albedo of rocks and the dust of the case do not."""
    campaign = load_campaign(campaign_name)
    own = find_site(campaign.base_parameters())
    changed = find_site(campaign.with_values({f"{table}.lunar_fraction": 0.0, f"{table}.surge_amplitude": 0.0}))
    assert (changed.photometry.lunar_fraction, changed.photometry.surge_amplitude) == (0.0, 0.0)
    assert own.photometry.lunar_fraction > 0.0
    assert changed.photometry.rock_albedo == own.photometry.rock_albedo
    assert changed.environment == own.environment
