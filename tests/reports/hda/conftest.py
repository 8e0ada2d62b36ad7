"""Fixtures of a synthetic landing."""

from typing import Any

import pytest

from tests.reports.hda.synthetic_landing import synthetic_products


@pytest.fixture
def hda_products() -> dict[str, Any]:
    """Return products of a synthetic landing; see `synthetic_products`."""
    return synthetic_products()
