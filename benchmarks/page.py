"""Write the measured figures as `docs/performance.md`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

TEMPLATE = Path(__file__).with_name("performance.md")
PAGE = Path(__file__).parents[1] / "docs" / "performance.md"


def write_page(record: Mapping[str, Any]) -> None:
    """Write the page from the record in `benchmarks.json`."""
    rows = ["| quantity | bound | median |", "|---|---|---|"]
    rows += [f"| {name} | {kept['asked']} | {kept['median']:.3g} |" for name, kept in record["figures"].items()]
    machine = record["machine"]
    where = f"{record['measured'][:10]}, {machine['cores']} cores of {machine['processor']}, {record['gl']}"
    text = TEMPLATE.read_text(encoding="utf-8").replace("{figures}", "\n".join(rows)).replace("{machine}", where)
    PAGE.write_text(text, encoding="utf-8")
