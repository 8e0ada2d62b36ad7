"""Command `marsyard new`: write a campaign file from options, or from the answers to questions."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.errors import handle_user_errors
from marsyard.cli.options import OverwriteOption

if TYPE_CHECKING:
    from marsyard.campaigns.definition.campaign import Campaign
    from marsyard.scenarios.template import CampaignTemplate, Choices


@handle_user_errors
def new(
    name: Annotated[str, Argument(metavar="NAME", help="Name of the campaign; the file is NAME.toml.")],
    system: Annotated[
        str | None,
        Option(help="Type of the system under test, such as velocity, tracking or landing; an unknown one lists all."),
    ] = None,
    site: Annotated[str | None, Option(help="A site from `marsyard terrain list`.")] = None,
    camera: Annotated[
        str | None,
        Option(metavar="FILE", help="Custom camera file (docs/custom-worlds.md); by default a camera of the system."),
    ] = None,
    detector: Annotated[str | None, Option(metavar="FILE", help="Custom detector datasheet in TOML.")] = None,
    flight: Annotated[
        str | None,
        Option(
            metavar="FILE", help="Recorded trajectory (docs/custom-worlds.md); by default the dynamics are simulated."
        ),
    ] = None,
    axes: Annotated[str, Option(help="World axes of the trajectory: enu or ned.")] = "enu",
    bound: Annotated[
        float | None,
        Option(
            metavar="X",
            help="Limit of the requirement: maximum error of the velocity (m/s) or of the tracked position (m), or "
            "minimum fraction of selected landing sites that are safe.",
        ),
    ] = None,
    cases: Annotated[int, Option("--cases", "-n", metavar="N", min=1, help="Number of cases.")] = 24,
    out: Annotated[Path | None, Option(metavar="FILE", help="File to write; by default NAME.toml.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a campaign file with comments; ask for missing options when run interactively."""
    from marsyard.campaigns.errors import CampaignError, unknown_name_message
    from marsyard.cli.estimate import evidence_limits
    from marsyard.reports.wording import count
    from marsyard.scenarios.systems import templates
    from marsyard.scenarios.template import Choices
    from marsyard.sim.terrain import sites

    path = Path(f"{name}.toml") if out is None else out
    if path.exists() and not overwrite:
        raise CampaignError(f"{path}: the file exists; use --overwrite to replace it, or --out to write another file")
    if not name or any(letter in name for letter in '/\\"\n'):
        raise CampaignError(f"'{name}' is not a valid campaign name: slashes and quotes are not allowed")
    is_interactive, available = system is None and _is_terminal(), templates()
    find_problem = partial(_find_name_problem, list(available))
    system = system or _ask_user("System", next(iter(available)), is_interactive, find_problem)
    if system not in available:
        raise CampaignError(f"--system: {unknown_name_message('system', system, available)}")
    template = available[system]
    ask_camera, ask_flight = (
        is_interactive and option not in template.unsupported_options for option in ("camera", "flight")
    )
    site_names = [key for key, preset in sites().items() if getattr(preset, template.scale) is not None]
    site = site or _ask_user("Site", template.site, is_interactive, partial(_find_name_problem, site_names))
    question = "Camera file (empty: the paper's camera)"
    camera = camera or _ask_user(question, "", ask_camera, _find_camera_problem)
    flight = flight or _ask_user("Trajectory file (empty: simulated)", "", ask_flight, _find_file_problem)
    question, default = f"Requirement: {template.bound_text}", f"{template.bound:g}"
    if bound is None:
        bound = float(_ask_user(question, default, is_interactive, partial(_find_number_problem, template.max_bound)))
    elif problem := _find_number_problem(template.max_bound, f"{bound:g}"):
        raise CampaignError(f"--bound: {problem}")
    choices = Choices(
        name, site, camera=camera, detector=detector or "", flight=flight, axes=axes, bound=bound, cases=cases
    )
    campaign = _write_and_load(path, template, choices)
    summary = f"{path}: {system} over {site}, {count(cases, 'case')}"
    typer.echo(f"{summary}. To show it: `marsyard show {path}`. To run it:\n  marsyard run {path}")
    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")


def _is_terminal() -> bool:
    """Whether a user can answer questions on standard input."""
    return sys.stdin.isatty()


def _write_and_load(path: Path, template: CampaignTemplate, choices: Choices) -> Campaign:
    """Write the campaign file and load it; if it is invalid, restore the previous content of the path."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError, report_write_errors

    previous_text = path.read_text(encoding="utf-8") if path.exists() else None
    try:
        with report_write_errors(f"{path}:"):
            path.write_text(template.text(choices), encoding="utf-8")
    except ValueError as error:
        raise CampaignError(str(error)) from error
    try:
        return load_campaign(str(path))
    except CampaignError:
        if previous_text is None:
            path.unlink()
        else:
            path.write_text(previous_text, encoding="utf-8")
        raise


def _ask_user(question: str, default: str, is_interactive: bool, find_problem: Callable[[str], str]) -> str:
    """Ask the user until the answer is valid (`find_problem` returns ""); return the default if not interactive."""

    def check(answer: str) -> str:
        if problem := find_problem(answer):
            raise typer.BadParameter(problem)
        return answer

    if not is_interactive:
        return default
    return str(typer.prompt(question, default=default, show_default=bool(default), value_proc=check))


def _find_name_problem(allowed: Sequence[str], answer: str) -> str:
    """Return the problem of an answer that must be an allowed name; empty if there is none."""
    from marsyard.campaigns.errors import unknown_name_message

    return "" if answer in allowed else unknown_name_message("answer", answer, allowed)


def _find_file_problem(answer: str) -> str:
    """Return the problem of an answer that must be an existing file or empty; empty if there is none."""
    is_missing = answer and not Path(answer).is_file()
    return f"{answer}: no such file; allowed: the path of a file, or an empty answer" if is_missing else ""


def _find_camera_problem(answer: str) -> str:
    """Return the problem of an answer that must be a camera file or empty; empty if there is none."""
    from marsyard.sim.camera import CameraFileError, read_camera

    try:
        if answer:
            read_camera(answer)
    except CameraFileError as error:
        return f"{error}; allowed: the path of a camera file, or an empty answer"
    return ""


def _find_number_problem(limit: float, answer: str) -> str:
    """Return the problem of an answer that must be a number above 0 and below `limit`; empty if there is none."""
    try:
        number = float(answer)
    except ValueError:
        number = 0.0
    upper_limit = "" if limit == math.inf else f" and below {limit:g}"
    return "" if 0.0 < number < limit else f"'{answer}' is not allowed; allowed: a number above 0{upper_limit}"
