"""Command `marsyard conformance`: check that a custom algorithm or component follows its interface."""

import json
from dataclasses import asdict
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.options import JsonOption
from marsyard.cli.terminal import create_console


@handle_user_errors
def conformance(
    algorithm: Annotated[
        str,
        Argument(
            metavar="ALGORITHM",
            help="Algorithm, dynamics, instrument or custom score: a name, module:Class, exec:PROGRAM (started "
            "per case) or serve:PROGRAM (one process for all cases).",
        ),
    ],
    task: Annotated[
        str | None,
        Option(
            metavar="TASK",
            help="Interface to check: velocity, tracking, landing, localisation, dynamics, instrument or score; by "
            "default inferred from the methods of the class.",
        ),
    ] = None,
    time_limit: Annotated[float, Option(metavar="S", help="Time limit of one call in seconds.", min=0.1)] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Check that a custom algorithm, dynamics model, instrument or score follows its interface and time limit."""
    from marsyard.campaigns.running.conformance import create_subject, run_conformance_checks
    from marsyard.scenarios.parts.named import KINDS

    candidate = create_subject(algorithm, task, time_limit)
    findings = []
    if not as_json:
        kind = "custom component" if candidate.task in KINDS else "algorithm"
        typer.echo(f"checking {algorithm} as {candidate.task} ({kind})")
    for finding in run_conformance_checks(candidate):
        findings.append(finding)
        if as_json:
            continue
        result = "[green]ok  [/]" if finding.passed else "[bold red]FAIL[/]"
        create_console().print(f"{result} {finding.check:<14}", end="", highlight=False)
        lines = [f"{finding.requirement} ({finding.note})" if finding.note else finding.requirement]
        if not finding.passed:
            lines += [f"{'':20}{line}" for line in (finding.problem, f"to fix: {finding.next_step}")]
        for line in lines:
            create_console().print(line, markup=False, highlight=False, soft_wrap=True)
    failures = sum(not finding.passed for finding in findings)
    if as_json:
        checks = [{**asdict(finding), "passed": finding.passed} for finding in findings]
        data = {"algorithm": candidate.spec, "task": candidate.task, "passed": not failures, "checks": checks}
        typer.echo(json.dumps(data, indent=2))
    else:
        typer.echo(f"{len(findings) - failures} of {len(findings)} checks passed")
    if failures:
        raise typer.Exit(Exit.FAILED)
