"""Tests of the dashboard server: invalid paths and requests for other hosts are rejected."""

import http.client
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from marsyard.reports.dashboard import server
from marsyard.reports.dashboard.server import create_server


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Serve a folder with an empty folder and a link to a file outside of it."""
    (tmp_path / "site" / "c").mkdir(parents=True)
    (tmp_path / "site" / "index.html").write_text("the site")
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "site" / "outside-link").symlink_to(tmp_path / "secret.txt")
    with create_server(tmp_path / "site", "127.0.0.1", 0) as http_server:
        threading.Thread(target=http_server.serve_forever, daemon=True).start()
        yield http_server.server_port
        http_server.shutdown()


def _request_status(port: int, path: str, host: str | None) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.putrequest("GET", path, skip_host=True)
        if host is not None:
            connection.putheader("Host", host)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


#: Null bytes, a long name, a folder, and paths to a file outside of the site.
INVALID = ("/%00", "/a%00b/index.html", "/" + 5000 * "a", "/%2e%2e/%00", "/c/", "/../secret.txt", "/%2e%2e/secret.txt")


@pytest.mark.parametrize("path", [*INVALID, "/outside-link"])
def test_invalid_paths_are_not_found(port: int, path: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert _request_status(port, path, f"127.0.0.1:{port}") == 404
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", None])
def test_requests_for_another_host_are_rejected(port: int, host: str | None) -> None:
    assert _request_status(port, "/", host) == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST:1234", "[::1]:80"])
def test_requests_for_this_host_are_answered(port: int, host: str) -> None:
    assert _request_status(port, "/", host) == 200


def test_answers_allow_no_foreign_scripts_and_no_frames(port: int) -> None:
    for path in ("/", "/missing"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("GET", path)
        headers = connection.getresponse().headers
        connection.close()
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "'unsafe-inline'" not in policy.partition("script-src")[2]
        assert (headers["X-Content-Type-Options"], headers["X-Frame-Options"]) == ("nosniff", "DENY")


@pytest.mark.slow
def test_connections_are_limited_in_number_and_time(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that sends one letter after the other holds a connection for a limited time only."""
    monkeypatch.setattr(server, "REQUEST_S", 4.0)
    slow = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(server.MAX_CONNECTIONS)]
    for connection in slow:
        connection.sendall(b"G")
    time.sleep(0.3)
    with socket.create_connection(("127.0.0.1", port), timeout=20) as further:
        assert further.recv(1) == b""
    assert slow[0].recv(1) == b""
    for connection in slow:
        connection.close()
    assert _request_status(port, "/", "127.0.0.1") == 200


def test_reset_connections_print_nothing(port: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "site" / "large.html").write_bytes(bytes(30_000_000))
    for request in (b"", b"GET / HT", b"GET /large.html HTTP/1.0\r\nHost: localhost\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
            connection.sendall(request)
            time.sleep(0.2)
            # closing with a linger time of zero resets the connection
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    time.sleep(0.2)
    assert capfd.readouterr().err == ""
