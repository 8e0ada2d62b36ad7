"""Misbehaving cases among healthy ones, with the runner killed in between: the short form of the validation's soak."""

from __future__ import annotations

from pathlib import Path

from benchmarks.validation.soak import soak


def test_misbehaving_cases_and_a_killed_runner_change_no_other_case_and_leave_nothing(tmp_path: Path) -> None:
    found = soak(tmp_path, cases=30, kills=1, misbehaving=0.5, killed_after_s=(4.0, 8.0))
    assert found.ended
    assert len(set(found.deeds)) > 8
    assert found.wrong_outcomes == ()
    assert found.changed == ()
    assert found.processes == 0
    assert found.files == 0
