"""A stored campaign with what its rows show of its requirements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.reports.overall import Overall, exit_code, overall
from marsyard.reports.sampled import Sampled, sampled
from marsyard.reports.stored import StoredRun, read_run
from marsyard.reports.verdicts import Verdict, judge_campaign


@dataclass(frozen=True)
class Judged:
    """A stored campaign, how its cases were drawn, and its verdicts: each requirement's, and the whole one."""

    run: StoredRun
    how: Sampled
    verdicts: Sequence[Verdict]
    whole: Overall

    @property
    def exit_code(self) -> int:
        """The exit status that goes with the verdicts."""
        return exit_code(self.verdicts, bool(self.whole.crashed))


def judged(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> Judged:
    """Judges a campaign's stored rows, by its own requirements or by those given.

    Raises
    ------
    marsyard.campaigns.errors.StoreError
        Where the folder holds no rows.
    """
    run = read_run(directory, requirements)
    how = sampled(run.configuration)
    verdicts = judge_campaign(run.whole, run.requirements, how)
    return Judged(run, how, verdicts, overall(verdicts, run.whole, how))
