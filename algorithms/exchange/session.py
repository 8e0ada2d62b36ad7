"""One algorithm's talk with a program that answers line by line: its process, and the folder that it reads from."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from marsyard.algorithms.exchange import serving
from marsyard.algorithms.exchange.process import Command, ExecutableLimits, Said
from marsyard.algorithms.exchange.replies import ProgramDetails
from marsyard.algorithms.faults import AlgorithmError


class Session:
    """A program that is asked line by line, started when it is first asked.

    Attributes
    ----------
    folder
        Where what it reads is written; goes with the session.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._server: serving.Server | None = None
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
        request = {"do": do, **told}
        with tempfile.TemporaryDirectory(prefix=f"{do}-", dir=self.folder) as below:
            for key, write in (files or {}).items():
                folder = Path(below) / key
                folder.mkdir()
                write(folder)
                request[key] = str(folder)
            answer, said = self._ask_server(request)
        return answer, ProgramDetails(said.stderr, said.time_s)

    def _ask_server(self, request: Mapping[str, Any]) -> tuple[Mapping[str, Any], Said]:
        if self._server is None:
            self._server = serving.taken(self._command, self._limits)
            self._leave = weakref.finalize(self, serving.given_back, self._command, self._limits, self._server)
        try:
            return self._server.ask(request)
        except AlgorithmError:
            # it is ended already, and is not to be asked by others
            if self._leave is not None:
                self._leave.detach()
            raise
