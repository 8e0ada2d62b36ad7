"""`marsyard new` and `ingest`: a campaign from flags or a short dialogue, and one from recorded pictures."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import OverwriteOption, handle_user_errors, with_options

if TYPE_CHECKING:
    from marsyard.campaigns.definition.campaign import Campaign
    from marsyard.scenarios.systems import Ingested
    from marsyard.scenarios.template import CampaignTemplate, Choices

CAMPAIGN_FILE = "campaign.toml"


@dataclass(frozen=True)
class NewOptions:
    """Arguments and options of `marsyard new`."""

    name: Annotated[str, Argument(metavar="NAME", help="Name of the campaign; the file is NAME.toml.")]
    system: Annotated[str | None, Option(help="System under test, such as velocity; a wrong name lists all.")] = None
    site: Annotated[str | None, Option(help="One of `marsyard terrain list`.")] = None
    camera: Annotated[str | None, Option(metavar="FILE", help="Custom camera file (docs/custom-worlds.md).")] = None
    detector: Annotated[str | None, Option(metavar="FILE", help="Custom detector datasheet in TOML.")] = None
    flight: Annotated[str | None, Option(metavar="FILE", help="Trajectory file in place of the dynamics.")] = None
    axes: Annotated[str, Option(help="World axes of the trajectory: enu or ned.")] = "enu"
    bound: Annotated[float | None, Option(metavar="X", help="Requirement: maximum error or minimum fraction.")] = None
    cases: Annotated[int, Option("--cases", "-n", metavar="N", min=1, help="Number of cases.")] = 24
    out: Annotated[Path | None, Option(metavar="FILE", help="Instead of NAME.toml.")] = None
    overwrite: OverwriteOption = False


@handle_user_errors
@with_options(NewOptions)
def new(given: NewOptions) -> None:
    """Write a commented campaign of your own; at a terminal asks for what is not given."""
    from marsyard.campaigns.errors import CampaignError, unknown_name_message
    from marsyard.cli.outcome import evidence_limits
    from marsyard.reports.wording import count
    from marsyard.scenarios.systems import template_paths
    from marsyard.scenarios.template import Choices
    from marsyard.scenarios.user_files import import_object
    from marsyard.sim.terrain import sites

    name = given.name
    path = Path(f"{name}.toml") if given.out is None else given.out
    if path.exists() and not given.overwrite:
        raise CampaignError(f"{path}: there already; --overwrite replaces it, --out writes another")
    if not name or any(letter in name for letter in '/\\"\n'):
        raise CampaignError(f"'{name}' is no name for a campaign: without slashes and quotes")
    asked, known = given.system is None and _is_terminal(), template_paths()
    chosen = given.system or _answer("System", next(iter(known)), asked, partial(_find_word_problem, list(known)))
    if chosen not in known:
        raise CampaignError(f"--system: {unknown_name_message('system', chosen, known)}")
    template: CampaignTemplate = import_object(known[chosen])
    asks_camera, asks_flight = (asked and option not in template.refused for option in ("camera", "flight"))
    with_terrain = [name for name, one in sites().items() if getattr(one, template.scale) is not None]
    site = given.site or _answer("Site", template.site, asked, partial(_find_word_problem, with_terrain))
    camera = given.camera or _answer("Camera's file (empty: the paper's camera)", "", asks_camera, _find_camera_problem)
    flight = given.flight or _answer("Trajectory's file (empty: simulated)", "", asks_flight, _find_file_problem)
    question, default = f"Requirement: {template.bound_text}", f"{template.bound:g}"
    bound = math.nan if given.bound is None else given.bound
    if math.isnan(bound):
        bound = float(_answer(question, default, asked, partial(_find_number_problem, template.max_bound)))
    choices = Choices(name, site, camera, given.detector or "", flight, given.axes, bound, given.cases)
    loaded = _write_and_load(path, template, choices)
    where = f"{path}: {chosen} over {site}, {count(given.cases, 'case')}"
    typer.echo(f"{where}. See it with `marsyard show {path}`, run it with\n  marsyard run {path}")
    for limit in evidence_limits(loaded):
        typer.echo(f"note: {limit}")


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _write_and_load(path: Path, template: CampaignTemplate, choices: Choices) -> Campaign:
    """Write the campaign and load it; where it cannot be loaded, restore what the path held before."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError, report_write_errors

    before = path.read_text(encoding="utf-8") if path.exists() else None
    try:
        with report_write_errors(f"{path}:"):
            path.write_text(template.text(choices), encoding="utf-8")
    except ValueError as error:
        raise CampaignError(str(error)) from error
    try:
        return load_campaign(str(path))
    except CampaignError:
        path.unlink() if before is None else path.write_text(before, encoding="utf-8")
        raise


def _answer(question: str, default: str, asked: bool, find_problem: Callable[[str], str]) -> str:
    """The answer at the terminal, asked for again while it has a problem; or the default."""

    def check(answer: str) -> str:
        if problem := find_problem(answer):
            raise typer.BadParameter(problem)
        return answer

    if not asked:
        return default
    return str(typer.prompt(question, default=default, show_default=bool(default), value_proc=check))


def _find_word_problem(allowed: Sequence[str], answer: str) -> str:
    from marsyard.campaigns.errors import unknown_name_message

    return "" if answer in allowed else unknown_name_message("answer", answer, allowed)


def _find_file_problem(answer: str) -> str:
    missing = answer and not Path(answer).is_file()
    return f"{answer}: no such file; allowed: the path of a file, or nothing" if missing else ""


def _find_camera_problem(answer: str) -> str:
    from marsyard.sim.camera import CameraFileError, read_camera

    try:
        if answer:
            read_camera(answer)
    except CameraFileError as error:
        return f"{error}; allowed: the path of a camera's file, or nothing"
    return ""


def _find_number_problem(limit: float, answer: str) -> str:
    try:
        number = float(answer)
    except ValueError:
        number = 0.0
    below = "" if limit == math.inf else f" and below {limit:g}"
    return "" if 0.0 < number < limit else f"'{answer}' is not allowed; allowed: a number above 0{below}"


@handle_user_errors
def ingest(
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="ingest.toml, pictures.csv and pictures (docs/real-pictures.md).")
    ],
    out: Annotated[Path, Option(metavar="DIR", help="New folder of the cases and their campaign.")],
    system: Annotated[str | None, Option(help="System of the cases; by default real pictures.")] = None,
) -> None:
    """Make a campaign of real cases from pictures with measured attitude and altitude."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors, unknown_name_message
    from marsyard.reports.wording import count
    from marsyard.scenarios.systems import systems
    from marsyard.scenarios.user_files import import_object

    known = {one.name: one.ingest for one in systems() if one.ingest}
    chosen = system or next(iter(known))
    if chosen not in known:
        raise CampaignError(f"--system: {unknown_name_message('system', chosen, known)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} is there already, and is not empty; name a new folder with --out")
    unfinished = out.with_name(f"{out.name}.part{os.getpid()}")
    try:
        with report_write_errors(f"{out}:"):
            unfinished.mkdir(parents=True)
            made: Ingested = import_object(known[chosen])(folder, unfinished, out.resolve())
            (unfinished / CAMPAIGN_FILE).write_text(made.campaign, encoding="utf-8")
            if out.exists():
                out.rmdir()
            unfinished.rename(out)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    try:
        load_campaign(str(out / CAMPAIGN_FILE))
    except CampaignError:  # a campaign that cannot be run is not kept
        shutil.rmtree(out)
        raise
    typer.echo(f"{count(made.cases, 'case')} of {count(made.pictures, 'picture')}: {out}")
    if made.note:
        typer.echo(made.note)
    typer.echo(f"run them with: marsyard run {out / CAMPAIGN_FILE}")
