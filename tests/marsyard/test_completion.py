"""The shell completes commands and their options, as `marsyard --install-completion` sets it up."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from marsyard.cli import app


@pytest.mark.parametrize(
    ("words", "place", "completed"),
    [("marsyard con", 1, {"conformance"}), ("marsyard clean --y", 2, {"--yes"}), ("marsyard terrain l", 2, {"list"})],
)
def test_words_are_completed(words: str, place: int, completed: set[str]) -> None:
    environment = {"_MARSYARD_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(place)}
    ended = CliRunner().invoke(app, [], prog_name="marsyard", env=environment)
    assert set(ended.output.split()) == completed
