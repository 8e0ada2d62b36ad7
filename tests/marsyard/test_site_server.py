"""Tests of the dashboard server: invalid paths and requests for other hosts are rejected."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from marsyard.cli.outcome import create_server


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    (tmp_path / "index.html").write_text("the site")
    with create_server(tmp_path, "127.0.0.1", 0) as http_server:
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


@pytest.mark.parametrize("path", ["/%00", "/a%00b/index.html", "/" + 5000 * "a", "/%2e%2e/%00"])
def test_invalid_paths_are_not_found(port: int, path: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert _request_status(port, path, f"127.0.0.1:{port}") == 404
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", None])
def test_requests_for_another_host_are_rejected(port: int, host: str | None) -> None:
    assert _request_status(port, "/", host) == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST:1234", "[::1]:80"])
def test_requests_for_this_host_are_answered(port: int, host: str) -> None:
    assert _request_status(port, "/", host) == 200
