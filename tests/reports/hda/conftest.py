"""Products of a made-up landing for every test."""

from __future__ import annotations

from typing import Any

import pytest

from tests.reports.hda.made_up import synthetic_products


@pytest.fixture
def hda_products() -> dict[str, Any]:
    """A fresh copy for every test; see `synthetic_products`."""
    return synthetic_products()
