"""Errors that a user can fix: one message without a traceback, exit status 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass


class CampaignError(Exception):
    """Base class of the errors that a user can fix."""


class StoreError(CampaignError):
    """A campaign folder that cannot be written, or that does not contain the requested data."""


@contextmanager
def report_write_errors(target: object) -> Iterator[None]:
    """Convert an OSError inside the context to a StoreError which reports that `target` cannot be written."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class Problem:
    """One problem: its location (a file or an option), its key, and a message with the allowed values."""

    location: str
    key: str
    message: str

    def __str__(self) -> str:
        """Format the problem in one line; control characters are escaped."""
        text = ": ".join(part for part in (self.location, self.key, self.message) if part)
        return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


class DefinitionError(CampaignError):
    """A campaign with an invalid definition; `problems` lists all problems, at least one."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def suggest_similar(word: str, allowed: Iterable[str]) -> str:
    """Return ``(did you mean 'x'?)`` with a leading space if an allowed word is similar; otherwise an empty text."""
    matches = difflib.get_close_matches(word, list(allowed), n=1)
    return f" (did you mean '{matches[0]}'?)" if matches else ""


def unknown_name_message(kind: str, word: str, allowed: Iterable[str], listed_only: Iterable[str] | None = None) -> str:
    """Create the message about an unknown word, with a similar word and the allowed words.

    - kind: what the word names, for example `campaign`
    - listed_only: words that are listed instead of all allowed words
    """
    allowed_words = sorted(allowed)
    words_text = ", ".join(allowed_words if listed_only is None else sorted(listed_only)) or "none"
    return f"unknown {kind} '{word}'{suggest_similar(word, allowed_words)}; allowed: {words_text}"
