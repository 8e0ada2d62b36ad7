"""Tests of assurance packages: what they contain, and that any change of them is found and named."""

import json
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from marsyard.campaigns.errors import CampaignError
from marsyard.reports.assurance.argument import ElementKind, GoalState, number_elements
from marsyard.reports.assurance.case import AssuranceCase, build_argument
from marsyard.reports.assurance.package import ARGUMENT, MANIFEST, hash_files, read_run_evidence, write_package
from marsyard.reports.assurance.signature import sign_file
from marsyard.reports.assurance.verification import verify_package
from marsyard.reports.validation_rows import VALIDATION_FILE, read_checks
from tests.command import marsyard
from tests.reports.assurance.stored_run import write_stored_run


@pytest.fixture(scope="module", autouse=True)
def _missed_check(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Replace the packaged checks by some with a missed one on descents over Gusev, for any measurements."""
    checks = json.loads(VALIDATION_FILE.read_text())
    row = next(row for row in checks["flight"]["rows"] if row["claim"].endswith("descent over gusev, upper limit"))
    row["limit"] = row["measured"] - 0.5 * abs(row["measured"])
    path = tmp_path_factory.mktemp("checks") / "validation.json"
    path.write_text(json.dumps(checks))
    rows = [row for check in read_checks(path).values() for row in check.rows]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("marsyard.reports.assurance.package.VALIDATION_FILE", path)
        # no test reads the figures of a report, which take most of the time
        patch.setattr("marsyard.reports.section.svg_markup", lambda *_: "<svg></svg>")
        patch.setattr(
            "marsyard.reports.validity.rows_of_system", lambda system: [row for row in rows if row.concerns(system)]
        )
        yield


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AssuranceCase]:
    """Write a package of one campaign of 240 cases; return its folder and its argument."""
    folder = tmp_path_factory.mktemp("assured")
    run = write_stored_run(folder / "run")
    (folder / "package").mkdir()
    return folder / "package", write_package([run], folder / "package")


@pytest.fixture
def stored(written: tuple[Path, AssuranceCase]) -> Path:
    """Return the folder of the package, which must not be changed."""
    return written[0]


@pytest.fixture
def package(stored: Path, tmp_path: Path) -> Path:
    """Copy the package, to change it."""
    return Path(shutil.copytree(stored, tmp_path / "package"))


RUN = "runs/dimes-synthetic"


def rehash(folder: Path) -> None:
    """Write the hashes of the present files: the change of a person who knows the layout of a package."""
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"files": hash_files(folder)}))


def replace_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def change_row(folder: Path) -> None:
    with closing(sqlite3.connect(folder / RUN / "cases.sqlite")) as connection, connection:
        (row,) = connection.execute("SELECT row FROM cases WHERE case_number = 7").fetchone()
        values = json.loads(row)
        values[3] = 0.001  # the velocity error
        connection.execute("UPDATE cases SET row = ? WHERE case_number = 7", (json.dumps(values),))


def change_table(folder: Path) -> None:
    path = folder / RUN / "cases.parquet"
    frame = pd.read_parquet(path)
    frame.loc[7, "velocity_error_m_s"] = 0.001
    frame.to_parquet(path)


def edit_json(name: str, edit: Callable[[Any], None]) -> Callable[[Path], None]:
    """Return a change of the content of a JSON file of the campaign."""

    def change(folder: Path) -> None:
        path = folder / RUN / name
        content = json.loads(path.read_text())
        edit(content)
        path.write_text(json.dumps(content))

    return change


def edit_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Return a change of the text of a file of the package."""
    return lambda folder: replace_text(folder / name, old, new)


change_page = edit_text("index.html", "Not shown", "Supported")


def change_validation_row(folder: Path) -> None:
    path = folder / "evidence/validation.json"
    rows = (row for check in json.loads(path.read_text()).values() for row in check["rows"])
    missed = next(row for row in rows if row["claim"] == "width of the correlation peak, px: minimum")
    replace_text(path, f'"measured": {missed["measured"]!r}', f'"measured": {missed["limit"]!r}')


def change_requirement(folder: Path) -> None:
    path = folder / RUN / "campaign.json"
    path.write_text(path.read_text().replace('"probability": 0.99', '"probability": 0.9'))


def test_package_verifies(package: Path) -> None:
    result = verify_package(package)
    assert result.problems == ()
    assert any("claims and page, computed again" in note for note in result.notes)
    # the verification does not write into the package
    assert hash_files(package) == json.loads((package / MANIFEST).read_text())["files"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (change_row, "the row of case 7 was changed"),
        (change_table, f"{RUN}: {RUN}/cases.parquet was changed"),
        (
            edit_json("report.json", lambda report: report["verdicts"][0].update(failures=9)),
            f"{RUN}/report.json: DIMES-VEL does not follow from the rows: failures",
        ),
        (
            edit_json("report.json", lambda report: report["validity"].update(missed=[])),
            f"{RUN}/report.json: validity does not follow from the rows",
        ),
        (
            edit_json("report.json", lambda report: report["robustness"][0].update(passes_at=20.0)),
            f"{RUN}/report.json: robustness does not follow from the rows",
        ),
        (
            edit_json("report.json", lambda report: report.update(verdict="PASS", exit_code=0)),
            f"{RUN}/report.json: verdict does not follow from the rows",
        ),
        (
            edit_json("report.json", lambda report: report["evidence"].update(kind="confirmation")),
            f"{RUN}/report.json: evidence does not follow from the rows",
        ),
        (
            edit_json("report.json", lambda report: report["verdicts"][0].update(all_cases=None, consumer_risk=0.0)),
            f"{RUN}/report.json: verdicts does not follow from the rows",
        ),
        (
            edit_json("report.json", lambda report: report.update(git_commit="abc")),
            f"{RUN}/report.json: git_commit does not follow from the rows",
        ),
        (
            edit_text(f"{RUN}/verification.csv", "PASS (exploration)", "PASS"),
            f"{RUN}/verification.csv: the content does not follow",
        ),
        (edit_text(f"{RUN}/junit.xml", "PASS (exploration)", "PASS"), f"{RUN}/junit.xml: the content does not follow"),
        (edit_text(ARGUMENT, "supported, with open defeaters", "supported"), "case.json: element G"),
        (edit_text("case.svg", "not shown", "supported"), "case.svg: the content does not follow"),
        (change_page, "index.html: the content does not follow"),
        (change_validation_row, "index.html: the content does not follow"),
        (edit_json("campaign.json", lambda record: record.update(seed=8)), f"{RUN}/campaign.json: seed is 8, "),
        (edit_json("campaign.json", lambda record: record.update(cases_finished=8)), f"{RUN}/campaign.json: cases_fin"),
        (
            edit_json("campaign.json", lambda record: record["definition"].update(seed=8)),
            f"{RUN}/campaign.json: the definition is not the one with which the rows were stored",
        ),
        (
            change_requirement,
            f"{RUN}/report.json: DIMES-VEL does not follow from the rows: probability 0.99, from the rows",
        ),
    ],
)
def test_changes_with_a_new_hash_are_found_and_named(package: Path, change: Callable[[Path], None], named: str) -> None:
    change(package)
    rehash(package)
    problems = verify_package(package).problems
    assert any(named in problem for problem in problems), problems


@pytest.mark.parametrize(
    "name", [f"{RUN}/report.html", f"{RUN}/cases.sqlite", f"{RUN}/campaign.json", "evidence/fitted.toml", "case.svg"]
)
def test_every_changed_file_is_named(package: Path, name: str) -> None:
    with (package / name).open("ab") as file:
        file.write(b" ")
    status, out, _ = marsyard("assure", "--verify", package)
    assert status == 1
    assert f"problem: {name}: the file was changed" in out
    assert "NOT VERIFIED" in out


@pytest.mark.parametrize("runs", ["5", '"limit-state"', '["../limit-state"]', '[".."]', "[" * 100_000])
def test_damaged_manifest_is_reported(package: Path, runs: str) -> None:
    (package / MANIFEST).write_text(f'{{"schema": 1, "files": {{}}, "runs": {runs}}}')
    with pytest.raises(CampaignError, match=f"{MANIFEST} is damaged"):
        verify_package(package)


def test_missing_additional_and_linked_files_are_named(package: Path) -> None:
    (package / RUN / "junit.xml").unlink()
    (package / "manifest.json.note").write_text("")
    (package / "evidence/link").symlink_to(package / "case.svg")
    problems = verify_package(package).problems
    assert f"{RUN}/junit.xml: the file is missing" in problems
    assert f"manifest.json.note: the file is not in {MANIFEST}" in problems
    assert f"evidence/link: the file is not in {MANIFEST}" in problems


def test_signature_shows_who_wrote_the_hashes(package: Path, tmp_path: Path) -> None:
    keys = [tmp_path / "key", tmp_path / "other"]
    for key in keys:
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
    signers, others = tmp_path / "signers", tmp_path / "others"
    for file, key in zip((signers, others), keys, strict=True):
        file.write_text(f"board@example.org {key.with_suffix('.pub').read_text()}")
    assert verify_package(package, signers).problems == ("manifest.json.sig: the package is not signed",)
    sign_file(package / MANIFEST, keys[0])
    result = verify_package(package, signers)
    assert result.problems == ()
    assert any("board@example.org" in note for note in result.notes)
    assert verify_package(package).problems == ()
    unknown = f"manifest.json.sig: the key of the signature is not in {others}"
    assert verify_package(package, others).problems == (unknown,)
    # new hashes of a changed page have no signature
    change_page(package)
    rehash(package)
    assert any(problem.startswith("manifest.json.sig: ") for problem in verify_package(package, signers).problems)
    assert any(problem.startswith("manifest.json.sig: ") for problem in verify_package(package).problems)


def test_case_has_all_kinds_of_defeaters(written: tuple[Path, AssuranceCase]) -> None:
    folder, argument = written
    texts = [item.text for _, item, _ in argument.defeaters]
    beginnings = (
        "The required rate or bound is assumed", "Exploration: the seed was chosen freely", "Missed check (",
        "69 of 240 cases", "Fitted to statistics of Spirit", "Nobody outside of the project", "validation, level 1",
    )  # fmt: skip
    for beginning in beginnings:
        assert any(text.startswith(beginning) for text in texts), beginning
    # an exploration does not show that its cases are new
    assert argument.root.state in (GoalState.OPEN, GoalState.REFUTED)
    content = argument.to_json()
    names = [name for name, _, _ in number_elements(argument.root)]
    assert [item["id"] for item in content["elements"]] == names
    assert {link["target"] for link in content["links"] if link["type"] == "supportedBy"} <= set(names)
    assert len([link for link in content["links"] if link["type"] == "challenges"]) == len(argument.defeaters)
    for _, item, _ in number_elements(argument.root):
        assert not item.evidence or (folder / item.evidence).is_file()


def test_failed_requirement_refutes_the_claim(tmp_path: Path) -> None:
    run = write_stored_run(tmp_path / "run")
    record = (run / "campaign.json").read_text()
    (run / "campaign.json").write_text(record.replace('"bound": 5.0', '"bound": 0.001'))
    (tmp_path / "package").mkdir()
    argument = write_package([run], tmp_path / "package")
    assert argument.root.state is GoalState.REFUTED
    solution = next(item for _, item, _ in number_elements(argument.root) if item.kind is ElementKind.SOLUTION)
    assert solution.text.startswith("FAIL: ")


def test_page_opens_offline(stored: Path) -> None:
    page = (stored / "index.html").read_text()
    assert "default-src 'none'" in page
    assert "http://" not in page.replace("http://www.w3.org/", "")
    assert "https://" not in page
    assert "<svg" in page


def test_packages_of_two_runs_of_a_campaign_have_two_folders(tmp_path: Path) -> None:
    runs = [write_stored_run(tmp_path / name, cases=12) for name in ("a", "b")]
    status, out, _ = marsyard("assure", *runs, "--out", tmp_path / "package")
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "package/runs").iterdir()) == [
        "dimes-synthetic",
        "dimes-synthetic-2",
    ]
    assert f"to verify: marsyard assure --verify {tmp_path / 'package'}" in out
    assert verify_package(tmp_path / "package").problems == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"state": "interrupted"}, "is not finished"), ({"study": {"kind": "search"}}, "contains a study")],
)
def test_studies_and_unfinished_campaigns_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    run = write_stored_run(tmp_path / "run", cases=12, **changes)
    status, _, error = marsyard("assure", run, "--out", tmp_path / "package")
    assert status == 2
    assert message in error
    assert not (tmp_path / "package").exists()


def test_invalid_commands_have_one_message(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("")
    run = tmp_path / "missing"
    for arguments, message in (
        ((), "give the folders"),
        ((run,), f"{run}"),
        ((run, "--out", tmp_path / "full"), "is not an empty folder"),
        (("--verify", tmp_path / "full"), "is no assurance package"),
        ((run, "--verify", tmp_path), "give no RUN"),
        ((run, "--signers", tmp_path / "full/file"), "--signers needs --verify"),
    ):
        status, _, error = marsyard("assure", *arguments)
        assert status == 2
        assert message in error.replace("\n", " ")


def test_key_that_does_not_exist_leaves_no_package(tmp_path: Path) -> None:
    run = write_stored_run(tmp_path / "run", cases=12)
    status, _, error = marsyard("assure", run, "--out", tmp_path / "package", "--sign", tmp_path / "key")
    assert (status, "no such file" in error, (tmp_path / "package").exists()) == (2, True, False)


def test_package_of_another_layout_is_refused(package: Path) -> None:
    (package / MANIFEST).write_text(json.dumps({"schema": 99}))
    with pytest.raises(CampaignError, match="schema 99"):
        verify_package(package)


def test_report_of_another_layout_is_checked_by_its_rows_and_hashes(package: Path) -> None:
    replace_text(package / RUN / "report.json", '"schema": 8', '"schema": 9')
    manifest = json.loads((package / MANIFEST).read_text())
    (package / MANIFEST).write_text(json.dumps(manifest | {"program": "0"}))
    rehash(package)
    result = verify_package(package)
    assert result.problems == ()
    assert f"{RUN}: verdicts by their hash only; the report has another layout" in result.notes
    change_row(package)
    rehash(package)
    assert "the row of case 7 was changed" in " ".join(verify_package(package).problems)


def test_package_verifies_in_another_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report hides the home folder of its author in the path of a program, the record does not."""
    program = "/home/author/estimator"
    algorithm = {"spec": f"exec:{program} --fast", "role": "tested", "path": program, "options": {}}
    run = write_stored_run(tmp_path / "run", cases=12, algorithms=[algorithm])
    monkeypatch.setenv("HOME", "/home/author")
    (tmp_path / "package").mkdir()
    write_package([run], tmp_path / "package")
    monkeypatch.setenv("HOME", "/home/reader")
    assert verify_package(tmp_path / "package").problems == ()
    change = edit_json("report.json", lambda report: report["algorithm_details"][0].update(name="exec:~/other --fast"))
    change(tmp_path / "package")
    rehash(tmp_path / "package")
    assert any("algorithm_details" in problem for problem in verify_package(tmp_path / "package").problems)


def test_package_of_another_version_is_checked_without_its_page(package: Path) -> None:
    manifest = json.loads((package / MANIFEST).read_text())
    (package / MANIFEST).write_text(json.dumps(manifest | {"marsyard": "9.9", "program": "0"}))
    result = verify_package(package)
    assert result.problems == ()
    assert any(
        "claims and page by their hashes only; written by marsyard 9.9 (0), this is" in note for note in result.notes
    )


def test_robustness_of_the_report_supports_or_challenges_a_verdict(stored: Path) -> None:
    run = read_run_evidence(stored, RUN)
    (verdict,) = run.report.verdicts
    assert verdict.status.is_met
    items = [
        {"requirement": "DIMES-VEL", "parameter": "imu.scale", "pass_text": "131 ppm of gyro scale (100 assumed)"},
        {"requirement": "DIMES-VEL", "parameter": "wind", "pass_text": ""},
        {"requirement": "OTHER", "parameter": "haze", "pass_text": "haze 0.8"},
    ]
    texts = [
        [item.text for _, item, _ in number_elements(build_argument([case_run], stored).root)]
        for case_run in (run, replace(run, data={"robustness": items}), replace(run, data={"robustness": []}))
    ]
    not_computed = "Robustness against other dispersions: not computed."
    assert "PASS holds up to: 131 ppm of gyro scale (100 assumed)" in texts[1]
    assert "The cases do not show that PASS holds under a change of: wind." in texts[1]
    assert not_computed not in texts[1]
    assert not_computed in texts[2]


def test_computing_time_and_observed_rate_are_defeaters(stored: Path) -> None:
    run = read_run_evidence(stored, RUN)
    (verdict,) = run.report.verdicts
    timed = replace(verdict, metric="estimation_time_s", scale=60.0, decide_by="estimate")
    root = build_argument([replace(run, report=replace(run.report, verdicts=(timed,)))], stored).root
    texts = [item.text for _, item, _ in number_elements(root)]
    assert any("assumed to be 60 times slower than the host" in text for text in texts)
    assert "Evaluated by observed rate, not at a confidence." in texts
