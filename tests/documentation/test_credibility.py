"""The page on credibility has the factors of the assurance packages."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_page_has_the_packaged_factors() -> None:
    factors = tomllib.loads((ROOT / "reports/credibility.toml").read_text())["factors"]
    page = (ROOT / "docs/credibility.md").read_text().splitlines()
    rows = [line for line in page if line.startswith("| ") and not line.startswith("| factor")]
    assert rows == [f"| {item['name']} | {item['group']} | {item['level']} | {item['reasons']} |" for item in factors]
    assert all(0 <= int(item["level"][0]) <= 4 for item in factors)
