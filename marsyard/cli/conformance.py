"""`marsyard conformance`: check an algorithm, or a custom motion, instrument or score, against its protocol."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import Exit, JsonOption, console, handle_user_errors


@handle_user_errors
def conformance(
    algorithm: Annotated[
        str, Argument(metavar="ALGORITHM", help="A name, module:Class, exec:PROGRAM or serve:PROGRAM.")
    ],
    task: Annotated[
        str | None,
        Option(
            metavar="TASK",
            help="velocity, tracking, landing, dynamics, instrument or score; by default from its methods.",
        ),
    ] = None,
    time_limit: Annotated[float, Option(metavar="S", help="Time limit of one answer in seconds.", min=0.1)] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Check an algorithm, or a custom motion, instrument or score, against its protocol: types, inputs, time, ..."""
    from marsyard.campaigns.running.conformance import examine, subject_of
    from marsyard.scenarios.parts.named import KINDS

    subject = subject_of(algorithm, task, time_limit)
    findings = []
    if not as_json:
        kind = "a part of the kind" if subject.task in KINDS else "an algorithm for"
        typer.echo(f"{algorithm} as {kind} {subject.task}")
    for finding in examine(subject):
        findings.append(finding)
        if as_json:
            continue
        word = "[green]ok  [/]" if finding.passed else "[bold red]FAIL[/]"
        console().print(f"{word} {finding.check:<14}", end="", highlight=False)
        lines = [f"{finding.asked} ({finding.note})" if finding.note else finding.asked]
        if not finding.passed:
            lines += [f"{'':20}{line}" for line in (finding.problem, f"next: {finding.next_step}")]
        for line in lines:
            console().print(line, markup=False, highlight=False, soft_wrap=True)
    failed = sum(not finding.passed for finding in findings)
    if as_json:
        checks = [{**asdict(one), "passed": one.passed} for one in findings]
        data = {"algorithm": subject.spec, "task": subject.task, "passed": not failed, "checks": checks}
        typer.echo(json.dumps(data, indent=2))
    else:
        typer.echo(f"{len(findings) - failed} of {len(findings)} checks passed")
    if failed:
        raise typer.Exit(Exit.FAILED)
