"""Options and arguments of several commands of `marsyard`."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

CampaignArgument = Annotated[
    str, Argument(metavar="CAMPAIGN", help="A name from `marsyard list`, or the path of a TOML file.")
]
SiteArgument = Annotated[
    str,
    Argument(
        metavar="SITE",
        help="A site from `marsyard terrain list`, or a digital terrain model (DTM): .tif, .img, .cub or .npz.",
    ),
]
MaxHolesOption = Annotated[
    float | None,
    Option(
        metavar="F",
        min=0.0,
        max=0.99,
        help="Accept a DTM with up to this fraction of missing elevations, which are filled; by default 0.05.",
    ),
]
CasesOption = Annotated[
    int | None, Option("-n", "--cases", metavar="N", help="Number of cases; by default that of the campaign.")
]
SeedOption = Annotated[
    int | None, Option(metavar="S", help="Root seed of the random draws; by default that of the campaign.")
]
#: Default record of confirmations.
CONFIRMATIONS = Path("confirmations.jsonl")
ConfirmationsOption = Annotated[
    Path, Option(metavar="FILE", help="Record of confirmations; keep it under version control.")
]
JsonOption = Annotated[bool, Option("--json", help="Print JSON.")]
DirectoryArgument = Annotated[Path, Argument(metavar="DIR", help="Folder of a campaign run.")]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a value, such as render.backend=egl; the parameter is then fixed and not dispersed.",
    ),
]
AlgorithmOption = Annotated[
    list[str] | None,
    Option(
        metavar="NAME",
        help="The algorithm under test: a name, module:Class, exec:PROGRAM (started per case) or serve:PROGRAM "
        "(one process for all cases). If repeated, all algorithms run on the same cases and are compared; the first is "
        "under test.",
    ),
]
JobsOption = Annotated[int | None, Option(metavar="J", help="Worker processes; by default one per core.")]
ClusterOption = Annotated[
    str | None, Option(metavar="ADDRESS", help="Run on Dask: a scheduler at tcp://HOST:PORT, or local:N to start one.")
]
CaseTimeOption = Annotated[
    float | None, Option(metavar="S", help="Time limit of a case in seconds (limits.case_time_s).")
]
ChangedOption = Annotated[
    bool, Option("--allow-changed", help="Continue with changed code or versions; the change is recorded.")
]
TrustOption = Annotated[
    bool,
    Option(
        "--trust",
        help="Accept a folder that was created or changed elsewhere: its rows, and the code that it names. The code is "
        "executed; it must be the recorded code.",
    ),
]

OutOption = Annotated[Path | None, Option(metavar="DIR", help="Output folder; by default runs/<campaign>-<UTC time>.")]
OverwriteOption = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
