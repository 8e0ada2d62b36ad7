"""HTTP server of a dashboard's folder: it serves files only, to a limited number of connections of limited duration."""

import ipaddress
import socket
import sys
import threading
from collections.abc import Collection
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from marsyard.reports import explorer
from marsyard.reports.dashboard.site import read_script
from marsyard.reports.page_environment import script_hash

#: Maximum number of connections at the same time; further ones are closed.
MAX_CONNECTIONS = 64
#: Time limits of receiving a request, and of sending the answer, seconds.
REQUEST_S, ANSWER_S = 10.0, 120.0
_SCRIPTS = " ".join(f"'{script_hash(script)}'" for script in (read_script(), explorer.read_script()))
_HEADERS = {
    "Content-Security-Policy": (
        f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {_SCRIPTS}; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}


class _Handler(SimpleHTTPRequestHandler):
    """Handler of requests for files in the dashboard's folder, without folder listings and log messages.

    `names` are the allowed host names of the server.
    """

    def __init__(self, *args: Any, names: Collection[str], **kwargs: Any) -> None:
        self._names = names
        super().__init__(*args, **kwargs)

    def setup(self) -> None:
        """Limit the time of the connection."""
        super().setup()
        self._limit = self._close_after(REQUEST_S)

    def finish(self) -> None:
        """End the time limit."""
        self._limit.cancel()
        super().finish()

    def _close_after(self, seconds: float) -> threading.Timer:
        """Close the connection after a time, however slowly the other side reads or writes."""
        timer = threading.Timer(seconds, self._close)
        timer.daemon = True
        timer.start()
        return timer

    def _close(self) -> None:
        with suppress(OSError):  # it is closed already
            self.connection.shutdown(socket.SHUT_RDWR)

    def parse_request(self) -> bool:
        """Reject requests with the host name of a different server (protection against DNS rebinding)."""
        if not super().parse_request():
            return False
        self._limit.cancel()
        self._limit = self._close_after(ANSWER_S)
        if not is_own_host(self.headers.get("Host", ""), self._names):
            self.send_error(403, "this server does not have that host name")
            return False
        return True

    def translate_path(self, path: str) -> str:
        """Map the path of a URL to a file; a path outside the dashboard's folder maps to a missing file."""
        root = Path(self.directory).resolve()
        try:
            target = Path(super().translate_path(path)).resolve()
        except (OSError, ValueError):  # for example a name with a zero byte
            return str(root / "no such file")
        return str(target if target.is_relative_to(root) else root / "no such file")

    def end_headers(self) -> None:
        """Allow pages only what they need: their styles, embedded images and the scripts of this version; no frames."""
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def list_directory(self, path: object) -> None:
        """Reject the request."""
        self.send_error(404, "no such file")

    def log_message(self, *_: object) -> None:
        """Print no log messages."""


def is_own_host(header: str, names: Collection[str]) -> bool:
    """Whether a Host header contains a name of this server, or an IP address (which DNS cannot redirect).

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


class DashboardServer(ThreadingHTTPServer):
    """Server with a limited number of connections."""

    def __init__(self, *args: Any) -> None:
        self._free = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(*args)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a request in a thread; close the connection if there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a request."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print no traceback for a connection that the other side has closed."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def create_server(directory: Path, host: str, port: int) -> DashboardServer:
    """Create an HTTP server of a dashboard's folder; port 0 selects a free port."""
    names = {"localhost", host.lower(), socket.gethostname().lower()}
    return DashboardServer((host, port), partial(_Handler, directory=str(directory), names=names))
