"""Tests of confirmations: runs on calibration seeds give no PASS; confirmations are recorded, joined and shown.

A confirmation (`marsyard run --confirm`) evaluates frozen content on a seed that is derived from it. The record of
confirmations is committed to git; `test_confirmation_attacks.py` contains attempts to obtain PASS without evidence.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from marsyard.campaigns.definition.claims import confirmation_seed, freeze_algorithm
from marsyard.campaigns.definition.evidence import EvidenceKind
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.confirmation_record import is_variant, read_record
from marsyard.campaigns.store.confirmations import (
    create_record,
    extend_confirmation,
    reserve_confirmation,
    select_confirmation_seed,
)
from marsyard.campaigns.store.git_history import find_registration_problem
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore
from marsyard.campaigns.store.table import write_table
from marsyard.scenarios.interface import IdentifiesTerrains
from marsyard.scenarios.systems import catalogue
from marsyard.sim.terrain.bank import TerrainBank
from tests.marsyard.confirmation_project import (
    BAD_LUCK,
    CALIBRATION,
    CAMPAIGN,
    RECORD,
    Command,
    commit_all,
    confirm,
    git,
    read_evidence,
    read_statuses,
)

SHIPPED_RECORD = Path(__file__).parents[2] / "benchmarks" / "results" / RECORD
FAILING_CASES = "FAKE_FAILING_CASES"


def test_run_on_a_seed_used_for_calibration_cannot_pass(marsyard: Command, tmp_path: Path) -> None:
    (tmp_path / "fake.toml").write_text(CAMPAIGN + CALIBRATION)
    output = marsyard("run", "fake.toml", "--out", "calibration", "--jobs", 1)
    assert (output.status, read_statuses(tmp_path / "calibration")) == (3, ["INSUFFICIENT"])
    assert "The verdict would be PASS. Calibrated on these cases" in output.text
    assert "error_scale" in output.out
    assert read_evidence(tmp_path / "calibration").kind is EvidenceKind.CALIBRATION


def test_exploration_states_that_it_is_no_confirmation_and_changed_requirements(
    marsyard: Command, tmp_path: Path
) -> None:
    changed = "The requirements are not those with which the campaign was started."
    output = marsyard("run", "fake.toml", "--out", "run", "--jobs", 1)
    assert (output.status, "verdict: PASS (exploration)" in output.out, changed in output.out) == (0, True, False)
    assert "evidence: Exploration" in output.out
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert (report["verdict"], changed in report["evidence"]["text"]) == ("PASS (exploration)", False)
    _weaken_requirement(tmp_path / "run")
    assert changed in " ".join(marsyard("report", "run").out.split())
    assert changed in json.loads((tmp_path / "run" / "report.json").read_text())["evidence"]["text"]


def test_first_confirmation_with_a_committed_record_passes(marsyard: Command, tmp_path: Path) -> None:
    campaign = load_campaign("fake.toml")
    claim = freeze_algorithm(campaign).claim
    assert confirm(marsyard, "run-1") == (0, ["PASS"])
    (entry,) = read_record(tmp_path / RECORD).confirmations
    assert (entry.claim, entry.number, entry.cases, entry.results) == (claim, 1, 10, {"VELOCITY": "PASS"})
    stored = json.loads((tmp_path / "run-1" / "campaign.json").read_text())
    # seed and seed of the terrains follow from the content alone
    assert stored["seed"] == entry.seed == confirmation_seed(claim, "") != campaign.definition.seed
    assert stored["definition"]["parameters"]["bank_seed"] == entry.bank_seeds["bank_seed"] > 1
    assert marsyard("confirmations").out.endswith("record: registered\n")
    # the recorded command repeats the run with the same terrains
    words = stored["command"]["words"]
    assert [f"bank_seed={entry.bank_seeds['bank_seed']}" in words, str(entry.seed) in words] == [True, True]


def test_second_confirmation_adds_its_cases_to_the_first(
    marsyard: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as context:
        context.setenv(FAILING_CASES, "4 6")
        assert confirm(marsyard, "run-1") == (3, ["INSUFFICIENT"])
    commit_all(tmp_path)
    # 10 cases without failure would be PASS; 20 with two failures are not
    assert confirm(marsyard, "run-2") == (3, ["INSUFFICIENT"])
    report = json.loads((tmp_path / "run-2" / "report.json").read_text())
    assert [report["verdicts"][0][name] for name in ("n", "failures", "terrains")] == [20, 2, 20]
    assert "This run alone: 0 of 10 cases failed." in report["verdicts"][0]["note"]
    assert "joint evidence of the confirmations 1, 2" in report["evidence"]["text"]
    first, second = read_record(tmp_path / RECORD).confirmations
    assert second.seed == confirmation_seed(second.claim, first.head) != first.seed
    assert second.bank_seeds != first.bank_seeds
    # 50 cases with two failures are PASS, and so is the report of the first run
    assert confirm(marsyard, "run-3", "-n", 30) == (0, ["PASS"])
    assert marsyard("report", "run-1").status == 0
    assert json.loads((tmp_path / "run-1" / "report.json").read_text())["verdicts"][0]["n"] == 50
    assert len(read_record(tmp_path / RECORD).confirmations) == 3


def test_unregistered_record_is_stated(marsyard: Command, tmp_path: Path) -> None:
    git(tmp_path, "rm", "-q", "--cached", RECORD)
    git(tmp_path, "commit", "-q", "-m", "no record")
    (tmp_path / RECORD).unlink()
    assert confirm(marsyard, "run-1") == (4, ["PASS (unregistered)"])
    output = marsyard("report", "run-1")
    assert (output.status, "No record of earlier runs is known here" in output.text) == (4, True)
    page = (tmp_path / "run-1" / "report.html").read_text()
    assert "No record of earlier runs is known here" in page
    assert "PASS (unregistered)" in page
    assert marsyard("dashboard", tmp_path, "--out", "site").status == 0
    assert "PASS (unregistered)" in (tmp_path / "site" / "index.html").read_text()


def test_record_is_found_after_it_moved_with_the_run(
    confirmed: Command, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    moved = tmp_path_factory.mktemp("elsewhere") / "project"
    shutil.copytree(tmp_path, moved)
    (tmp_path / RECORD).unlink()
    assert confirmed("report", moved / "run-1").status == 0
    # a later result is added to the moved record
    assert confirmed("append", moved / "run-1", 5, "--jobs", 1).status == 0
    assert read_record(moved / RECORD).confirmations[0].cases == 15


def test_verdict_without_its_record_is_no_pass(
    marsyard: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FAIL of an earlier confirmation is final; without the record it is unknown."""
    with monkeypatch.context() as patch:
        patch.setenv(*BAD_LUCK)
        assert confirm(marsyard, "run-1") == (1, ["FAIL"])
    commit_all(tmp_path)
    assert confirm(marsyard, "run-2", "-n", 20) == (1, ["FAIL"])
    (tmp_path / RECORD).unlink()
    output = marsyard("report", "run-2")
    assert (output.status, read_statuses(tmp_path / "run-2")) == (3, ["INSUFFICIENT"])
    places = f"{tmp_path / RECORD} does not exist, nor ../{RECORD} from the folder of the run"
    assert f"the record cannot be found. {places}" in " ".join(output.text.split())
    # a record without the entry of the run
    create_record(tmp_path / RECORD)
    output = marsyard("report", "run-2")
    assert (output.status, read_statuses(tmp_path / "run-2")) == (3, ["INSUFFICIENT"])
    assert f"{tmp_path / RECORD} does not contain this run" in " ".join(output.text.split())


def test_stopped_confirmation_is_repeated_with_the_same_cases(confirmed: Command, tmp_path: Path) -> None:
    path = tmp_path / RECORD
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))  # as if the run had been killed
    assert read_record(path).confirmations[0].is_unfinished
    output = confirmed("run", "fake.toml", "--confirm", "--out", "run-2", "-n", 9)
    assert (output.status, "repeat it with all its cases: --confirm -n 10" in output.err) == (2, True)
    assert confirm(confirmed, "run-3") == (0, ["PASS"])
    (entry,) = read_record(path).confirmations
    assert (entry.number, entry.is_unfinished) == (1, False)
    rows = [json.loads((tmp_path / name / "campaign.json").read_text())["seed"] for name in ("run-1", "run-3")]
    assert rows[0] == rows[1]


def test_appended_cases_are_announced_in_the_record(
    confirmed: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "copy").mkdir()
    for name in ("campaign.json", "cases.parquet", "cases.sqlite"):
        (tmp_path / "copy" / name).write_bytes((tmp_path / "run-1" / name).read_bytes())
    monkeypatch.setenv(*BAD_LUCK)
    assert confirmed("append", "run-1", 10, "--jobs", 1).status == 3
    (entry,) = read_record(tmp_path / RECORD).confirmations
    assert (entry.cases, entry.counted_cases, entry.first_cases) == (20, 20, 10)
    (counts,) = entry.counts.values()
    assert counts["terrains"] == [[0, 0, 0, 0, 1, 0, 10], [1, 0, 0, 0, 0, 0, 10]]
    # a copy of the folder before the appended cases is not the confirmation
    output = confirmed("report", "copy")
    reason = "The record announces 20 cases of confirmation 1; this folder contains 10."
    assert (output.status, reason in output.text) == (3, True)


def test_changed_code_invalidates_a_confirmation(confirmed: Command, tmp_path: Path) -> None:
    path = tmp_path / "run-1" / "campaign.json"
    record = json.loads(path.read_text())
    record["changes"] = [{"utc": "", "cases_before": 3, "in": ["code (abc, now def)"]}]
    path.write_text(json.dumps(record))
    output = confirmed("report", "run-1")
    assert (output.status, "code (abc, now def)" in output.text) == (3, True)
    # also an exploration and a calibration
    for kind, title in (("exploration", "mixed programs"), ("calibration", "calibrated on these cases")):
        path.write_text(json.dumps(record | {"evidence": {"kind": kind}}))
        output = confirmed("report", "run-1")
        assert (output.status, "code (abc, now def)" in output.text) == (3, True)
        assert "code (abc, now def)" in (tmp_path / "run-1" / "report.html").read_text()
        report = json.loads((tmp_path / "run-1" / "report.json").read_text())
        assert (report["verdict"], report["evidence"]["title"]) == ("INSUFFICIENT", title)
        assert "code (abc, now def)" in report["evidence"]["text"]


def test_other_requirements_invalidate_a_confirmation(confirmed: Command, tmp_path: Path) -> None:
    text = CAMPAIGN[CAMPAIGN.index("[[requirements]]") :].replace("0.75", "0.7")
    (tmp_path / "requirements.toml").write_text(text + 'campaigns = ["fake"]\n')
    output = confirmed("report", "run-1", "--requirements", "requirements.toml")
    assert (output.status, "requirements other than those of the campaign" in output.text) == (3, True)


def _weaken_requirement(run: Path) -> None:
    path = run / "campaign.json"
    path.write_text(path.read_text().replace('"probability": 0.75', '"probability": 0.5'))


def _change_dispersion(run: Path) -> None:
    path = run / "campaign.json"
    path.write_text(path.read_text().replace('"high": 99', '"high": 9'))
    (run / ROWS_FILE).unlink()  # its chain of hashes begins with the hash of the definition


def _replace_row(run: Path) -> None:
    """Replace the row of a case by one with a large error, in a folder whose rows this user signs."""
    with RowStore(run / ROWS_FILE) as store:
        row = store.row(0)
        assert row is not None
        store.add([{**row, "velocity_error_m_s": 1e9}])
        write_table(run / "cases.parquet", store)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_weaken_requirement, "requirements other than those in the record"),
        (_change_dispersion, "a definition other than that in the record"),
        (_replace_row, "results of cases other than those in the record"),
    ],
)
def test_folder_that_contradicts_the_record_is_no_confirmation(
    confirmed: Command, tmp_path: Path, change: Callable[[Path], None], text: str
) -> None:
    record = (tmp_path / RECORD).read_bytes()
    change(tmp_path / "run-1")
    output = confirmed("report", "run-1")
    assert (output.status, "Not the frozen evaluation: " in output.text, text in output.text) == (3, True, True)
    assert (tmp_path / RECORD).read_bytes() == record


def test_repeated_cases_are_announced_and_their_results_recorded(confirmed: Command, tmp_path: Path) -> None:
    """`marsyard resume --retry` replaces rows: the record then expects another result."""
    extend_confirmation(read_evidence(tmp_path / "run-1"), 10, repeats=True)
    assert read_record(tmp_path / RECORD).confirmations[0].is_unfinished
    _replace_row(tmp_path / "run-1")
    output = confirmed("report", "run-1")
    assert (output.status, "Not the frozen evaluation" in output.text) == (3, False)
    (entry,) = read_record(tmp_path / RECORD).confirmations
    assert (entry.is_unfinished, [counts["failures"] for counts in entry.counts.values()]) == (False, [1])


def test_campaigns_of_the_catalogue_are_no_copies_of_each_other(tmp_path: Path) -> None:
    """A copy of one with another name and width is related to all of its scenario, also to the original."""
    file = catalogue()["dimes-smoke"]
    copy = tmp_path / "copy.toml"
    copy.write_text(file.read_text().replace('"dimes-smoke"', '"copy"').replace("high = 3.0", "high = 3.0001"))
    entries = []
    for name in ("dimes-smoke", "dimes-gusev", "hda-benign", str(copy)):
        campaign = load_campaign(name, cases=24)
        path = tmp_path / RECORD
        reserve_confirmation(select_confirmation_seed(replace(campaign, confirmations=path)), tmp_path)
        entries.append(read_record(path).confirmations[-1])
    assert [entry.is_included for entry in entries] == [True, True, True, False]
    smoke, gusev, benign, changed = entries
    assert (is_variant(smoke, gusev), is_variant(changed, smoke)) == (False, False)
    assert [is_variant(entry, changed) for entry in (smoke, gusev, benign)] == [True, True, False]
    changed_option = load_campaign("dimes-smoke", ["algorithm=dimes-plus", "dimes.min_peak=0.9"], cases=24)
    reserve_confirmation(select_confirmation_seed(replace(changed_option, confirmations=path)), tmp_path)
    assert not read_record(path).confirmations[-1].is_included


def test_seed_of_the_first_confirmation_is_recognised_without_record(marsyard: Command) -> None:
    seed = confirmation_seed(freeze_algorithm(load_campaign("fake.toml")).claim, "")
    output = marsyard("run", "fake.toml", "--seed", seed, "--out", "early", "--jobs", 1)
    assert (output.status, "run without --confirm" in output.text) == (3, True)


def test_errors_are_reported_before_the_first_case(marsyard: Command, tmp_path: Path) -> None:
    confirm = ("run", "fake.toml", "--confirm")
    for words, message in (
        ((*confirm, "--seed", 3), "--confirm and --seed cannot be combined"),
        ((*confirm, "--set", "executable.isolated=false"), "isolated is false; allowed in a confirmation: true"),
        (("confirmations", "none.jsonl"), "no such file"),
        (("confirmations", "--create"), "exists"),
    ):
        output = marsyard(*words)
        assert (output.status, message in output.err) == (2, True), output
    (tmp_path / RECORD).write_text("{}\n")
    output = marsyard(*confirm, "--out", "run")
    assert (output.status, f"{RECORD}:1 is not an entry" in output.err) == (2, True)
    with pytest.raises(StoreError, match="not an entry"):
        read_record(tmp_path / RECORD)
    (tmp_path / "fake.toml").write_text(CAMPAIGN + CALIBRATION.replace("error_scale", "eror_scale"))
    output = marsyard("run", "fake.toml")
    assert (output.status, "calibration.runs[0].options[0]" in output.err) == (2, True)


def test_chain_contains_the_hash_of_all_earlier_bytes(tmp_path: Path) -> None:
    path = tmp_path / RECORD
    create_record(path)
    assert read_record(path).is_chained
    line = path.read_text()
    path.write_text(line.replace("created_utc", "created_at") + line)
    with pytest.raises(StoreError, match=f"{RECORD}:2: the chain of hashes is broken"):
        read_record(path)
    path.write_text(line.rstrip("\n"))
    with pytest.raises(StoreError, match="not an entry"):
        read_record(path)


def test_record_of_the_catalogue_is_valid_and_keeps_its_earlier_entries() -> None:
    record = read_record(SHIPPED_RECORD)
    assert record.is_chained
    former_entries = [entry for entry in record.confirmations if not entry.is_chained]
    assert len(former_entries) == 62
    undecided = dict.fromkeys(("HDA-SAFE", "HDA-CONVERGE"), "INSUFFICIENT")
    assert former_entries[-1].results == undecided | {"HDA-FIND": "FAIL"}


def test_record_in_a_shallow_clone_is_unregistered(marsyard: Command, tmp_path: Path) -> None:
    assert find_registration_problem(tmp_path / RECORD) == ""
    (tmp_path / "clone").mkdir()
    git(tmp_path / "clone", "clone", "-q", "--depth", "1", f"file://{tmp_path}", "shallow")
    assert "shallow clone" in find_registration_problem(tmp_path / "clone" / "shallow" / RECORD)


@pytest.mark.parametrize("name", ["dimes-smoke", "hda-benign", "vtt-montecarlo", "loc-smoke"])
def test_confirmations_of_each_system_use_other_terrains_than_the_campaign(name: str, tmp_path: Path) -> None:
    """A new seed of the bank gives every terrain of a case another identity; the record contains the seed."""
    campaign = replace(load_campaign(name, cases=8), confirmations=tmp_path / RECORD)
    confirmation = select_confirmation_seed(campaign)
    identities = []
    for item in (campaign, confirmation):
        assert isinstance(item.scenario, IdentifiesTerrains)
        cases = [item.scenario.terrain_identities(item.parameters(case), case) for case in range(4)]
        identities.append({identity for case in cases for identity in case})
    assert identities[0]
    assert identities[0].isdisjoint(identities[1])
    assert confirmation.calibration_overlap == 0.0


def test_terrains_of_one_dtm_have_one_identity() -> None:
    campaign = load_campaign("hda-benign")
    parameters = campaign.scenario.input_terrain(campaign.base_parameters(), 0)[0].parameters  # type: ignore[attr-defined]
    assert TerrainBank(parameters, 1).identity(0) != TerrainBank(parameters, 2).identity(0)
    assert TerrainBank(parameters, 1).identity(0) != TerrainBank(parameters, 1).identity(1)
