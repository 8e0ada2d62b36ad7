"""What a user must mend: each error here is printed as one message, without a traceback, and ends with status 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass


class CampaignError(Exception):
    """Base of the errors that a user can mend."""


class StoreError(CampaignError):
    """A campaign's folder that cannot be written, or does not hold what is asked of it."""


@contextmanager
def writing(what: object) -> Iterator[None]:
    """Raise StoreError, which names what cannot be written, where the system refuses it inside the context."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{what} cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: where it stands (a file or an option), under which key, and what is allowed."""

    where: str
    key: str
    message: str

    def __str__(self) -> str:
        """One line; what a file holds of control characters does not reach the terminal."""
        text = ": ".join(part for part in (self.where, self.key, self.message) if part)
        return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class ConfigurationError(CampaignError):
    """A campaign that cannot be run as it is written.

    Parameters
    ----------
    problems
        Everything that is wrong with it, at least one thing.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def near_match(word: str, allowed: Iterable[str]) -> str:
    """``(did you mean 'x'?)`` with a leading blank where one of the allowed words is near, otherwise nothing."""
    matches = difflib.get_close_matches(word, list(allowed), n=1, cutoff=0.6)
    return f" (did you mean '{matches[0]}'?)" if matches else ""


def not_allowed(what: str, word: str, allowed: Iterable[str], listed_only: Iterable[str] | None = None) -> str:
    """States that a word is unknown, which one is near, and which are allowed; of very many, those worth listing."""
    known = sorted(allowed)
    shown = known if listed_only is None else sorted(listed_only)
    listed = ", ".join(shown) if shown else "none"
    return f"unknown {what} '{word}'{near_match(word, known)}; allowed: {listed}"
