"""Write `docs/performance.md` from the template `benchmarks/performance.md` and the stored measurements."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

TEMPLATE = Path(__file__).with_name("performance.md")
PAGE = Path(__file__).parents[1] / "docs" / "performance.md"


def write_page(record: Mapping[str, Any]) -> None:
    """Write the page; `record` is the content of `benchmarks.json`."""
    rows = ["| quantity (core-s unless another unit is given) | limit | median |", "|---|---|---|"]
    rows += [f"| {name} | {row['limit']} | {row['median']:.3g} |" for name, row in record["figures"].items()]
    machine = record["machine"]
    conditions = f"{record['measured'][:10]}, {machine['cores']} cores of {machine['processor']}, {record['gl']}"
    text = (
        TEMPLATE.read_text(encoding="utf-8").replace("{measurements}", "\n".join(rows)).replace("{machine}", conditions)
    )
    PAGE.write_text(text, encoding="utf-8")
