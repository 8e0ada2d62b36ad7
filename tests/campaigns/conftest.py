"""Makes the fake scenario importable, here and in worker processes, and writes campaigns of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

HERE = str(Path(__file__).resolve().parent)
if HERE not in sys.path:
    sys.path.append(HERE)
    os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), HERE])

from fake_campaign import TROUBLE, Silence, run, write_campaign  # noqa: E402


@pytest.fixture
def campaign_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a campaign: `campaign_file(parameters="...", dispersions=..., requirement=..., head=..., more=...)`."""
    return partial(write_campaign, tmp_path)


@pytest.fixture
def watch() -> Silence:
    return Silence()


@pytest.fixture(scope="session")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign in which one case raises, two abort their process and one has no answer; to be left as it is."""
    folder = tmp_path_factory.mktemp("campaign")
    return run(write_campaign(folder, TROUBLE), folder / "troubled", Silence())
