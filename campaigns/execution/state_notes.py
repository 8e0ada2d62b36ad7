"""Notes on cases that changed the state of their worker process, few of each kind."""

from __future__ import annotations

from collections import Counter
from typing import Any

from marsyard.campaigns.execution.worker_process import Done

#: Cases that are named for each part of the state.
_NAMED = 3


class StateNotes:
    """Makes the notes of one run; counts what has been noted so far."""

    def __init__(self) -> None:
        self._noted: Counter[str] = Counter()

    def of(self, done: Done[Any]) -> str:
        """The note on a case; empty where there is nothing to note, or enough cases were named for the same reason."""
        notes = [
            self._limited(name.partition(" (")[0], f"case {done.item} changed its worker process: {name}")
            for name in done.changed
        ]
        if done.spoiled_by is not None:
            text = f"case {done.item} crashed in the worker that had run case {done.spoiled_by}, and not in a fresh one"
            notes.append(self._limited("spoiled", f"{text}: an earlier case changed the state of that worker"))
        return "; ".join(filter(None, notes))

    def _limited(self, kind: str, text: str) -> str:
        self._noted[kind] += 1
        if self._noted[kind] > _NAMED:
            return ""
        return f"{text} (further cases of this kind are not named)" if self._noted[kind] == _NAMED else text
