"""One confirmation, as the record of confirmations describes it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from marsyard.campaigns.definition.claims import FrozenAlgorithm


@dataclass(frozen=True)
class Confirmation:
    """A confirmation in the record of confirmations.

    - claim: identity of its content (`FrozenAlgorithm.claim`)
    - number: number of the confirmation of its claim, from 1
    - seed, bank_seeds: seed of the draws, and seeds of the terrain banks by parameter path
    - cases: number of cases that it has announced, with appended ones
    - first_cases: number of cases of its first look
    - max_cases: maximum number of cases of a run with `--until-decided`; otherwise None
    - overlap: see `Evidence`
    - requirements: name of each requirement, by `requirement_key`
    - results: status of each requirement at the latest look, by name; None before the first look
    - counted_cases, counts: number of cases and evidence of the latest look (`marsyard.reports.joint`)
    - failed: names of the requirements that were FAIL at any look
    - head: SHA-256 of the record up to the latest entry of the confirmation; the next confirmation depends on it
    - is_chained: False for an entry of an earlier version, which is not part of the chain of hashes
    """

    campaign: str
    number: int
    seed: int
    frozen: FrozenAlgorithm
    started_utc: str
    git_commit: str | None = None
    folder: str = ""
    cases: int = 0
    results: Mapping[str, str] | None = None
    claim: str = ""
    bank_seeds: Mapping[str, int] = field(default_factory=dict)
    first_cases: int = 0
    max_cases: int | None = None
    overlap: float | None = None
    requirements: Mapping[str, str] = field(default_factory=dict)
    counted_cases: int = 0
    counts: Mapping[str, Any] = field(default_factory=dict)
    failed: tuple[str, ...] = ()
    head: str = ""
    is_chained: bool = True

    @property
    def is_unfinished(self) -> bool:
        """Whether the record announces more cases than it has results of."""
        return self.results is None or (self.is_chained and self.counted_cases < self.cases)
