"""`marsyard conformance`: an algorithm, or a motion, instrument or score of one's own, put to its protocol's suite."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import Exit, JsonOption, console, handle_user_errors

if TYPE_CHECKING:
    from marsyard.scenarios.conformance import Finding, Subject


@handle_user_errors
def conformance(
    algorithm: Annotated[
        str, Argument(metavar="ALGORITHM", help="A name, module:Class, exec:PROGRAM or serve:PROGRAM.")
    ],
    task: Annotated[
        str | None,
        Option(
            "--task",
            metavar="TASK",
            help="velocity, tracking, landing, dynamics, instrument or score; by default from its methods.",
        ),
    ] = None,
    time_limit: Annotated[
        float, Option("--time-limit", metavar="S", help="Time limit of one answer in seconds.", min=0.1)
    ] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Put an algorithm, or your own motion, instrument or score, to its suite: right types, no change of inputs, ..."""
    from marsyard.campaigns.running.conformance import examine, subject_of
    from marsyard.scenarios.parts.named import KINDS

    subject = subject_of(algorithm, task, time_limit)
    findings = []
    if not as_json:
        typer.echo(
            f"{algorithm} as {'a part of the kind' if subject.task in KINDS else 'an algorithm for'} {subject.task}"
        )
    for finding in examine(subject):
        findings.append(finding)
        if not as_json:
            _print(finding)
    if as_json:
        typer.echo(json.dumps(_plain(subject, findings), indent=2))
    else:
        failed = sum(not finding.passed for finding in findings)
        typer.echo(f"{len(findings) - failed} of {len(findings)} checks passed")
    if not all(finding.passed for finding in findings):
        raise typer.Exit(Exit.FAILED)


def _print(finding: Finding) -> None:
    word = "[green]ok  [/]" if finding.passed else "[bold red]FAIL[/]"
    console().print(f"{word} {finding.check:<14}", end="", highlight=False)
    note = f" ({finding.note})" if finding.note else ""
    console().print(f"{finding.asked}{note}", markup=False, highlight=False, soft_wrap=True)
    if not finding.passed:
        for line in (finding.problem, f"next: {finding.next_step}"):
            console().print(f"{'':20}{line}", markup=False, highlight=False, soft_wrap=True)


def _plain(subject: Subject, findings: Sequence[Finding]) -> dict[str, object]:
    checks = [{**asdict(one), "passed": one.passed} for one in findings]
    passed = all(one.passed for one in findings)
    return {"algorithm": subject.spec, "task": subject.task, "passed": passed, "checks": checks}
