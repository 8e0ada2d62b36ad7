"""Tests that the commands which read a campaign's folder execute nothing that the folder names."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.campaigns.fake_campaign import RecordingWatch, run, write_campaign

#: A module that leaves a file when it is imported, or an object of it is constructed.
TRAP = """
from pathlib import Path
Path("executed").write_text("imported")
class Scenario: ...
class Estimator: ...
"""
#: Parameters of a stored campaign, by scenario, whose values name code.
NAMES: Mapping[str, dict[str, Any]] = {
    "trap:Scenario": {},
    "descent": {"algorithm": "trap:Estimator", "compared": ["trap.pkl:Estimator", "exec:./trap.sh"]},
    "landing": {"algorithm": "trap.pkl:Estimator", "compared": ["trap:Estimator"]},
    "rover": {"algorithm": "trap:Estimator", "compared": []},
    "localisation": {"algorithm": "trap:Estimator", "compared": []},
}
PARTS = {"motion": {"custom": "trap:Estimator"}, "scores": ["trap:Estimator"]}
COMMANDS = (
    ("report", "run"),
    ("report", "run", "--csv"),
    ("compare", "run", "other"),
    ("dashboard", ".", "--out", "site"),
    ("merge", "run", "other", "--out", "merged"),
)


class Trap:
    """An object that leaves a file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("open('executed', 'w').write('unpickled')",)


@pytest.mark.parametrize("scenario", list(NAMES))
def test_reading_commands_execute_nothing(tmp_path: Path, scenario: str) -> None:
    folder = run(write_campaign(tmp_path, "products = 'good'"), tmp_path / "run", RecordingWatch(), jobs=1)
    record = json.loads((folder / "campaign.json").read_text())
    record["configuration"] |= {"scenario": scenario, "parameters": NAMES[scenario] | PARTS}
    for entry in record["algorithms"]:
        entry |= {"spec": "trap:Estimator", "path": "trap:Estimator"}
    (folder / "campaign.json").write_text(json.dumps(record))
    shutil.copytree(folder, tmp_path / "other")
    (tmp_path / "trap.py").write_text(TRAP)
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps(Trap()))
    (tmp_path / "trap.sh").write_text("#!/bin/sh\ntouch executed\n")
    (tmp_path / "trap.sh").chmod(0o755)
    for command in COMMANDS:
        process = subprocess.run(
            [sys.executable, "-m", "marsyard", *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert "Traceback" not in process.stderr, process.stderr
        assert not (tmp_path / "executed").exists(), command
    assert (tmp_path / "run" / "report.html").exists()
