"""Write `docs/performance.md` from the template `benchmarks/performance.md` and the stored measurements.

The limits are for a machine on which the reference workload of `make bench-check` takes `REFERENCE_MS`. Run times and
rates of another machine are scaled by the time of its reference workload before they are compared with the limits:
``python -m benchmarks.page`` writes the page again.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TEMPLATE = Path(__file__).with_name("performance.md")
PAGE = Path(__file__).parents[1] / "docs" / "performance.md"
RESULTS = Path(__file__).parent / "results" / "benchmarks.json"
#: Name of the measurement of the reference workload, and its time on the machine of the limits, ms.
REFERENCE, REFERENCE_MS = "reference workload of make bench-check (ms)", 4.2
#: Units, at the end of a name, of quantities that do not depend on the speed of the machine, and of rates.
_FIXED_UNITS, _RATE_UNITS = ("GB", "MB", "%", "ratio", "min"), ("cases per wall s",)
_UNIT = re.compile(r"\(([^()]*)\)$")


def scale_value(name: str, value: float, reference_ms: float) -> float | None:
    """Scale a run time or rate to the machine of the limits; None for a quantity that does not depend on its speed.

    - name: name of the quantity, with its unit in brackets at the end; core-seconds without a unit
    - reference_ms: time of the reference workload on the machine of the measurement
    """
    match = _UNIT.search(name)
    unit = match.group(1) if match else ""
    if unit in _FIXED_UNITS:
        return None
    factor = REFERENCE_MS / reference_ms
    return value / factor if unit in _RATE_UNITS else value * factor


def is_within_limit(limit: str, value: float) -> bool | None:
    """Return whether a value meets a limit such as "<= 2"; None without a limit."""
    if not limit:
        return None
    sense, number = limit.split()
    return value <= float(number) if sense == "<=" else value >= float(number)


def write_page(record: Mapping[str, Any]) -> None:
    """Write the page; `record` is the content of `benchmarks.json`."""
    figures = record["figures"]
    reference_ms = figures[REFERENCE]["median"]
    head = "| quantity (core-s unless another unit is given) |"
    limits = [f"{head} limit | median | scaled | verdict |", "|---|---|---|---|---|"]
    others = [f"{head} median | scaled |", "|---|---|---|"]
    for name, row in figures.items():
        scaled = scale_value(name, row["median"], reference_ms)
        is_met = is_within_limit(row["limit"], row["median"] if scaled is None else scaled)
        values = f"{row['median']:.3g} | {'' if scaled is None else f'{scaled:.3g}'} |"
        if is_met is None:
            others.append(f"| {name} | {values}")
        else:
            limits.append(f"| {name} | {row['limit']} | {values} {'met' if is_met else '**missed**'} |")
    machine = record["machine"]
    conditions = f"{record['measured'][:10]}, {machine['cores']} cores of {machine['processor']}, {record['gl']}"
    texts = {
        "limits": "\n".join(limits),
        "comparison": "\n".join(others),
        "machine": conditions,
        "reference": f"{REFERENCE_MS:g}",
        "measured reference": f"{reference_ms:.3g}",
        "factor": f"{reference_ms / REFERENCE_MS:.2g}",
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    for key, value in texts.items():
        text = text.replace(f"{{{key}}}", value)
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_page(json.loads(RESULTS.read_text(encoding="utf-8")))
