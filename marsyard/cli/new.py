"""`marsyard new`: a commented campaign from flags or a short dialogue, which runs as it is written."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import OverwriteOption, handle_user_errors, with_options

if TYPE_CHECKING:
    from marsyard.campaigns.definition.campaign import Campaign
    from marsyard.scenarios.template import CampaignTemplate, Choices


@dataclass(frozen=True)
class NewOptions:
    """Arguments and options of `marsyard new`."""

    name: Annotated[str, Argument(metavar="NAME", help="Name of the campaign; the file is NAME.toml.")]
    system: Annotated[
        str | None,
        Option("--system", help="System under test, such as velocity; a wrong name lists all."),
    ] = None
    site: Annotated[str | None, Option("--site", help="One of `marsyard terrain list`.")] = None
    camera: Annotated[
        str | None, Option("--camera", metavar="FILE", help="Custom camera file (docs/custom-worlds.md).")
    ] = None
    detector: Annotated[str | None, Option("--detector", metavar="FILE", help="Custom detector datasheet in TOML.")] = (
        None
    )
    flight: Annotated[
        str | None, Option("--flight", metavar="FILE", help="Trajectory file in place of the dynamics.")
    ] = None
    axes: Annotated[str, Option("--axes", help="World axes of the trajectory: enu or ned.")] = "enu"
    bound: Annotated[
        float | None, Option("--bound", metavar="X", help="Requirement: maximum error or minimum fraction.")
    ] = None
    cases: Annotated[int, Option("--cases", "-n", metavar="N", min=1, help="Number of cases.")] = 24
    out: Annotated[Path | None, Option("--out", metavar="FILE", help="Instead of NAME.toml.")] = None
    overwrite: OverwriteOption = False


@handle_user_errors
@with_options(NewOptions)
def new(given: NewOptions) -> None:
    """Write a commented campaign of your own; at a terminal asks for what is not given."""
    from marsyard.campaigns.errors import CampaignError, not_allowed
    from marsyard.cli.evidence import evidence_limits
    from marsyard.reports.wording import count
    from marsyard.scenarios.import_path import import_object
    from marsyard.scenarios.systems import template_paths
    from marsyard.scenarios.template import Choices

    name = given.name
    path = Path(f"{name}.toml") if given.out is None else given.out
    if path.exists() and not given.overwrite:
        raise CampaignError(f"{path}: there already; --overwrite replaces it, --out writes another")
    if not name or any(letter in name for letter in '/\\"\n'):
        raise CampaignError(f"'{name}' is no name for a campaign: without slashes and quotes")
    asked, known = given.system is None and _is_terminal(), template_paths()
    chosen = given.system or _answer("System", next(iter(known)), asked, _one_of(list(known)))
    if chosen not in known:
        raise CampaignError(f"--system: {not_allowed('system', chosen, known)}")
    template: CampaignTemplate = import_object(known[chosen])
    stated = Choices(
        name=name,
        site=given.site or "",
        camera=given.camera or "",
        detector=given.detector or "",
        flight=given.flight or "",
        axes=given.axes,
        bound=math.nan if given.bound is None else given.bound,
        cases=given.cases,
    )
    choices = _completed(template, stated, asked)
    loaded = _written(path, template, choices)
    where = f"{path}: {chosen} over {choices.site}, {count(given.cases, 'case')}"
    typer.echo(f"{where}. See it with `marsyard show {path}`, run it with\n  marsyard run {path}")
    for limit in evidence_limits(loaded):
        typer.echo(f"note: {limit}")


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _completed(template: CampaignTemplate, given: Choices, asked: bool) -> Choices:
    """The choices with answers at the terminal, or the template's defaults, for what is not given."""
    asks_camera, asks_flight = (asked and option not in template.refused for option in ("camera", "flight"))
    site = given.site or _answer("Site", template.site, asked, _one_of(_sites(template.scale)))
    camera = given.camera or _answer("Camera's file (empty: the paper's camera)", "", asks_camera, _camera_file)
    flight = given.flight or _answer("Trajectory's file (empty: simulated)", "", asks_flight, _readable_file)
    question, usual = f"Requirement: {template.bound_text}", f"{template.bound:g}"
    bound = given.bound
    if math.isnan(bound):
        bound = float(_answer(question, usual, asked, _above_zero(template.max_bound)))
    return replace(given, site=site, camera=camera, flight=flight, bound=bound)


def _written(path: Path, template: CampaignTemplate, choices: Choices) -> Campaign:
    """Write the campaign and load it; where it cannot be loaded, restore what the path held before."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError

    before = path.read_text(encoding="utf-8") if path.exists() else None
    try:
        path.write_text(template.text(choices), encoding="utf-8")
    except ValueError as error:
        raise CampaignError(str(error)) from error
    except OSError as error:
        raise CampaignError(f"{path}: cannot be written: {error.strerror or error}") from error
    try:
        return load_campaign(str(path))
    except CampaignError:
        path.unlink() if before is None else path.write_text(before, encoding="utf-8")
        raise


def _answer(question: str, usual: str, asked: bool, check: Callable[[str], str]) -> str:
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


def _sites(scale: str) -> list[str]:
    """Sites with a terrain at a scale."""
    from marsyard.sim.terrain import sites

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
