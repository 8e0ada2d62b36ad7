"""Fixture of the tests of commands that do not examine worker processes."""

import pytest

from tests.inline_workers import use_inline_workers


@pytest.fixture
def inline_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run cases in the process of the test."""
    use_inline_workers(monkeypatch)
