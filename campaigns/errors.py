"""Errors that a user can fix: each is printed as one message, without a traceback, and ends with status 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass


class CampaignError(Exception):
    """Base class of the errors that a user can fix."""


class StoreError(CampaignError):
    """A campaign folder that cannot be written, or lacks the requested contents."""


@contextmanager
def writing(what: object) -> Iterator[None]:
    """Raise StoreError that names `what` where the system refuses to write it inside the context."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{what} cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class Problem:
    """One problem: its location (a file or an option), its key, and a message with the allowed values."""

    where: str
    key: str
    message: str

    def __str__(self) -> str:
        """One line, with the control characters of a file escaped."""
        text = ": ".join(part for part in (self.where, self.key, self.message) if part)
        return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class ConfigurationError(CampaignError):
    """A campaign that cannot be run as written; `problems` lists all that is wrong, at least one."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def near_match(word: str, allowed: Iterable[str]) -> str:
    """``(did you mean 'x'?)`` with a leading blank where an allowed word is similar, otherwise empty."""
    matches = difflib.get_close_matches(word, list(allowed), n=1, cutoff=0.6)
    return f" (did you mean '{matches[0]}'?)" if matches else ""


def not_allowed(what: str, word: str, allowed: Iterable[str], listed_only: Iterable[str] | None = None) -> str:
    """Message that a word is unknown, with a similar word and the allowed ones, or those of `listed_only`."""
    known = sorted(allowed)
    listed = ", ".join(known if listed_only is None else sorted(listed_only)) or "none"
    return f"unknown {what} '{word}'{near_match(word, known)}; allowed: {listed}"
