"""One algorithm's talk with a program that answers line by line: its process, and the folder that it reads from."""

from __future__ import annotations

import json
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from algorithms.exchange import serving
from algorithms.exchange.files import EXCHANGE
from algorithms.exchange.process import Child, Command, ExecutableLimits, Said
from algorithms.exchange.replies import ProgramDetails, table_of
from algorithms.faults import AlgorithmError


class Session:
    """A program that is asked line by line, started when it is first asked.

    Attributes
    ----------
    folder
        Where what it reads is written; goes with the session.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._child: Child | None = None
        self._leave: weakref.finalize[Any, Any] | None = None
        self.folder = Path(tempfile.mkdtemp(prefix="marsyard-talk-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def ask(
        self, do: str, told: Mapping[str, Any], files: Mapping[str, Callable[[Path], None]] | None = None
    ) -> tuple[Mapping[str, Any], ProgramDetails]:
        """The program's answer to one line, read but not checked.

        Parameters
        ----------
        do, told
            What it is asked, and what else stands in the line.
        files
            By the key that names the folder in the line: what writes it. It is there until the program has answered.
        """
        line = {"exchange": EXCHANGE, "do": do, **told}
        with tempfile.TemporaryDirectory(prefix=f"{do}-", dir=self.folder) as below:
            for key, write in (files or {}).items():
                folder = Path(below) / key
                folder.mkdir()
                write(folder)
                line[key] = str(folder)
            said = self._said(json.dumps(line, allow_nan=False))
        return table_of(said), ProgramDetails(said.stderr, said.time_s)

    def _said(self, line: str) -> Said:
        if self._child is None:
            self._child = serving.taken(self._command, self._limits)
            self._leave = weakref.finalize(self, serving.given_back, self._command, self._limits, self._child)
        try:
            return self._child.line(line)
        except AlgorithmError:
            # it is ended already, and is not to be asked by others
            if self._leave is not None:
                self._leave.detach()
            raise
