"""A server of a dashboard's files, apart from its command: the start of every other command does not wait for it."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class _Handler(SimpleHTTPRequestHandler):
    """Serves the site's files; lists no folders, follows nothing out of it, and keeps quiet."""

    def translate_path(self, path: str) -> str:
        """The file that a path of the address means; one that is not there where it leads out of the site."""
        found = Path(super().translate_path(path)).resolve()
        root = Path(self.directory).resolve()
        return str(found if found.is_relative_to(root) else root / "no such file")

    def list_directory(self, path: object) -> None:
        """Refuses."""
        self.send_error(404, "no such file")

    def log_message(self, *_: object) -> None:
        """Keeps quiet."""


def server(directory: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of a site's folder; port 0 takes one that is free."""
    return ThreadingHTTPServer((host, port), partial(_Handler, directory=str(directory)))
