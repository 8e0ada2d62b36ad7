"""`marsyard new`: a commented campaign from flags or a short dialogue, which runs as it is written."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from marsyard.cli.campaign import says_what_is_wrong


class System(StrEnum):
    """What a campaign puts to the test."""

    VELOCITY = "velocity"
    LANDING = "landing"
    TRACKING = "tracking"


#: What is asked for each system: site and the most that its error may be, in the unit of its metric.
_USUAL = {
    System.VELOCITY: ("gusev", 5.0, "horizontal velocity within this many m/s (5 of the DIMES requirement)"),
    System.LANDING: ("heli-hazardous", 0.99, "share of chosen sites that must be safe"),
    System.TRACKING: ("mars-yard", 0.03, "position of the target within this many metres at the goal"),
}


@says_what_is_wrong
def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the campaign; the file is NAME.toml.")],
    system: Annotated[
        System | None,
        typer.Option("--system", help="velocity (DIMES in a descent), landing (hazards), or tracking (a rover)."),
    ] = None,
    site: Annotated[str | None, typer.Option("--site", help="One of `marsyard terrain list`.")] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", metavar="FILE", help="Your camera's file (docs/own-worlds.md).")
    ] = None,
    detector: Annotated[
        str | None, typer.Option("--detector", metavar="FILE", help="Your detector's datasheet in TOML.")
    ] = None,
    flight: Annotated[
        str | None, typer.Option("--flight", metavar="FILE", help="Your trajectory, in place of the dynamics.")
    ] = None,
    axes: Annotated[str, typer.Option("--axes", help="The trajectory's world axes: enu or ned.")] = "enu",
    bound: Annotated[
        float | None, typer.Option("--bound", metavar="X", help="The requirement: most error, or least share.")
    ] = None,
    cases: Annotated[int, typer.Option("--cases", "-n", metavar="N", min=1, help="Number of cases.")] = 24,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Instead of NAME.toml.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")] = False,
) -> None:
    """Write a commented campaign of your own; at a terminal asks for what is not given."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.evidence import evidence_limits
    from marsyard.cli.new_campaign import Choices, campaign_text
    from marsyard.reports.wording import count

    path = Path(f"{name}.toml") if out is None else out
    if path.exists() and not overwrite:
        raise CampaignError(f"{path}: there already; --overwrite replaces it, --out writes another")
    if not name or any(letter in name for letter in '/\\"\n'):
        raise CampaignError(f"'{name}' is no name for a campaign: without slashes and quotes")
    asked = system is None and _is_terminal()
    chosen = System(_asked("System", "velocity", asked, _one_of(list(System)))) if system is None else system
    usual_site, usual_bound, about = _USUAL[chosen]
    site = site or _asked("Site", usual_site, asked, _one_of(_sites(chosen)))
    camera = camera or _asked(
        "Camera's file (empty: the paper's camera)", "", asked and chosen != System.TRACKING, _camera_file
    )
    flight = flight or _asked(
        "Trajectory's file (empty: simulated)", "", asked and chosen == System.VELOCITY, _readable_file
    )
    highest = 1.0 if chosen == System.LANDING else float("inf")
    stated = (
        float(_asked(f"Requirement: {about}", f"{usual_bound:g}", asked, _above_zero(highest)))
        if bound is None
        else bound
    )
    choices = Choices(name, chosen.value, site, camera, detector or "", flight, axes, stated, cases)
    text = campaign_text(choices)
    before = path.read_text(encoding="utf-8") if path.exists() else None
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CampaignError(f"{path}: cannot be written: {error.strerror or error}") from error
    try:
        loaded = load_campaign(str(path))
    except CampaignError:
        # what was asked for cannot be run: nothing of it stays
        path.unlink() if before is None else path.write_text(before, encoding="utf-8")
        raise
    typer.echo(
        f"{path}: {chosen.value} over {site}, {count(cases, 'case')}. See it with `marsyard show {path}`, run it with"
    )
    typer.echo(f"  marsyard run {path}")
    for limit in evidence_limits(loaded):
        typer.echo(f"note: {limit}")


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _asked(question: str, usual: str, asked: bool, check: Callable[[str], str]) -> str:
    """The answer at the terminal, asked for again until `check` accepts it; or the usual."""
    if not asked:
        return usual
    return str(typer.prompt(question, default=usual, show_default=bool(usual), value_proc=check))


def _one_of(allowed: Sequence[str]) -> Callable[[str], str]:
    """Accepts one of some words."""
    from marsyard.campaigns.errors import not_allowed

    def check(answer: str) -> str:
        if answer not in allowed:
            raise typer.BadParameter(not_allowed("answer", answer, allowed))
        return answer

    return check


def _sites(system: System) -> list[str]:
    """Sites that a system's scenario accepts: those with a terrain at its scale."""
    from marsyard.sim.terrain import sites

    scale = "descent" if system == System.VELOCITY else "ground"
    return [name for name, one in sites().items() if getattr(one, scale) is not None]


def _readable_file(answer: str) -> str:
    """Accepts nothing, or a file that is there."""
    if answer and not Path(answer).is_file():
        raise typer.BadParameter(f"{answer}: no such file; allowed: the path of a file, or nothing")
    return answer


def _camera_file(answer: str) -> str:
    """Accepts nothing, or a file that a camera is read from."""
    from marsyard.sim.camera import CameraFileError, read_camera

    if answer:
        try:
            read_camera(answer)
        except CameraFileError as error:
            raise typer.BadParameter(f"{error}; allowed: the path of a camera's file, or nothing") from error
    return answer


def _above_zero(highest: float) -> Callable[[str], str]:
    """Accepts a number above 0 and below `highest`."""

    def check(answer: str) -> str:
        try:
            number = float(answer)
        except ValueError:
            number = 0.0
        if not 0.0 < number < highest:
            below = "" if highest == float("inf") else f" and below {highest:g}"
            raise typer.BadParameter(f"'{answer}' is not allowed; allowed: a number above 0{below}")
        return answer

    return check
