"""A server of a dashboard's files, apart from its command: the start of every other command does not wait for it."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


class _Handler(SimpleHTTPRequestHandler):
    """Serves the site's files; lists no folders, follows nothing out of it, and keeps quiet.

    `names` are the host names by which the server may be addressed.
    """

    def __init__(self, *args: Any, names: Collection[str], **kwargs: Any) -> None:
        self._names = names
        super().__init__(*args, **kwargs)

    def parse_request(self) -> bool:
        """Refuse a request for another host: a foreign page whose name was bound to this address may not read."""
        if not super().parse_request():
            return False
        if not is_own_host(self.headers.get("Host", ""), self._names):
            self.send_error(403, "this server is not known by that host name")
            return False
        return True

    def translate_path(self, path: str) -> str:
        """The file that a path of the address means; one that is not there where it leads out of the site."""
        root = Path(self.directory).resolve()
        try:
            found = Path(super().translate_path(path)).resolve()
        except (OSError, ValueError):  # such as a name with a zero byte
            return str(root / "no such file")
        return str(found if found.is_relative_to(root) else root / "no such file")

    def list_directory(self, path: object) -> None:
        """Refuses."""
        self.send_error(404, "no such file")

    def log_message(self, *_: object) -> None:
        """Keeps quiet."""


def is_own_host(header: str, names: Collection[str]) -> bool:
    """Whether a Host header names this server: by an address, which no name server can redirect, or by a known name.

    >>> [is_own_host(text, ["localhost"]) for text in ("127.0.0.1:80", "[::1]", "LOCALHOST:8", "evil.example", "")]
    [True, True, True, False, False]
    """
    host = header.strip().lower()
    host = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
    if host in names:
        return True
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def server(directory: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of a site's folder; port 0 takes one that is free."""
    names = {"localhost", host.lower(), socket.gethostname().lower()}
    return ThreadingHTTPServer((host, port), partial(_Handler, directory=str(directory), names=names))
