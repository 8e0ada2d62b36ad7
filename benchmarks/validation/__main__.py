"""Run all validation checks, print the results and write docs/validation.md.

Usage: ``python -m benchmarks.validation [--only NAME]``, or with ``--pages`` to write only the pages. A check compares
measured properties of the simulation with limits (`records`).
"""

import argparse
import sys
import time

from rich.console import Console
from rich.table import Table

from benchmarks.validation import (
    air_checks,
    campaign_checks,
    controls,
    difference_checks,
    dimes_checks,
    document,
    flight_checks,
    geometry_checks,
    ground_checks,
    landing_checks,
    light_checks,
    map_checks,
    motion_checks,
    rare_checks,
    rare_verdicts,
    reference_checks,
    robust_checks,
    sampling_checks,
    sky_checks,
    soak,
    statistics_checks,
    tracking_checks,
)
from benchmarks.validation.records import Measure

CHECKS = (
    *geometry_checks.CHECKS,
    *motion_checks.CHECKS,
    *light_checks.CHECKS,
    *air_checks.CHECKS,
    *sky_checks.CHECKS,
    *reference_checks.CHECKS,
    *flight_checks.CHECKS,
    *map_checks.CHECKS,
    *ground_checks.CHECKS,
    *dimes_checks.CHECKS,
    *tracking_checks.CHECKS,
    *landing_checks.CHECKS,
    *sampling_checks.CHECKS,
    *campaign_checks.CHECKS,
    *soak.CHECKS,
    *statistics_checks.CHECKS,
    *difference_checks.CHECKS,
    *rare_checks.CHECKS,
    *rare_verdicts.CHECKS,
    *robust_checks.CHECKS,
    *controls.CHECKS,
)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.validation", description=__doc__)
    names = [check.name for check in CHECKS]
    parser.add_argument("--only", action="append", choices=names, help="run only this check; can be repeated")
    parser.add_argument(
        "--quick", action="store_true", help="fewer samples, the same limits; stores no results and writes no page"
    )
    parser.add_argument("--pages", action="store_true", help="only write the pages from the stored results")
    return parser.parse_args()


def _print_table(console: Console, title: str, measures: list[Measure]) -> None:
    """Print the measurements of one check."""
    table = Table(title=title, title_justify="left")
    for column in ("property", "limit", "measured", "", "method"):
        table.add_column(column, overflow="fold")
    for measure in measures:
        verdict = "-" if measure.limit is None else ("[green]met" if measure.passed else "[bold red]missed")
        limit = "" if measure.limit is None else document.format_value(measure, measure.limit)
        table.add_row(measure.claim, limit, document.format_value(measure, measure.measured), verdict, measure.how)
    console.print(table)


def main() -> int:
    """Run the selected checks. Returns 1 if a limit is missed."""
    arguments = _parse_arguments()
    console = Console()
    if arguments.pages:
        document.write_pages(CHECKS, document.read_stored())
        return 0
    results: dict[str, list[Measure]] = {}
    for check in CHECKS:
        if arguments.only and check.name not in arguments.only:
            continue
        start = time.perf_counter()
        results[check.name] = list(check.run(arguments.quick))
        _print_table(console, f"{check.name} ({time.perf_counter() - start:.0f} s)", results[check.name])
        if not arguments.quick:
            # after each check, so that an interruption loses only the current check
            document.write_pages(CHECKS, document.store({check.name: results[check.name]}, arguments.quick))
    missed_claims = [measure.claim for measures in results.values() for measure in measures if not measure.passed]
    for claim in missed_claims:
        console.print(f"[bold red]missed:[/] {claim}")
    return 1 if missed_claims else 0


if __name__ == "__main__":
    sys.exit(main())
