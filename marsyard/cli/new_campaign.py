"""The text of a new campaign: every table with a comment on what it is, what may be changed, and why it is so."""

from __future__ import annotations

import json
from dataclasses import dataclass

from marsyard.campaigns.errors import CampaignError
from marsyard.scenarios.descent.parameters import binned_size_for
from marsyard.sim.camera import CameraFileError, read_camera

#: Terrains of a new campaign's bank: enough for cases that are appended, and as many as a bank may have.
FEWEST_TERRAINS, MOST_TERRAINS = 10_000, 100_000


@dataclass(frozen=True)
class Choices:
    """What a new campaign is made from.

    Attributes
    ----------
    name, system, site
        The campaign's name; velocity, landing or tracking; a site.
    camera, detector, flight
        Files, or empty.
    axes
        World axes of the flight's file.
    bound
        Most error, or least share, that the requirement asks for.
    cases
        Number of cases.
    """

    name: str
    system: str
    site: str
    camera: str
    detector: str
    flight: str
    axes: str
    bound: float
    cases: int


def campaign_text(choices: Choices) -> str:
    """The campaign's file. Raises CampaignError for files that the system has no place for."""
    c = choices
    if c.system == "tracking" and (c.camera or c.detector):
        raise CampaignError(
            "--camera and --detector: tracking looks through a mast's stereo pair; see camera.preset and camera.own"
        )
    if c.flight and c.system != "velocity":
        raise CampaignError(f"--flight: only descents fly a file's trajectory, and {c.system} is none")
    parts = {"velocity": _velocity, "landing": _landing, "tracking": _tracking}[c.system](c)
    return "\n".join([_head(c, _SCENARIOS[c.system], _ABOUT[c.system]), *parts])


_SCENARIOS = {"velocity": "descent", "landing": "landing", "tracking": "rover"}
_ABOUT = {
    "velocity": "Horizontal velocity in a parachute descent.",
    "landing": "Safe landing sites found from two pictures of a moving camera.",
    "tracking": "A rover drives at a target and tracks it.",
}


def _head(c: Choices, scenario: str, about: str) -> str:
    return f"""# A campaign of Marsyard. Run it:      marsyard run {c.name}.toml
# Its parameters with their units:    marsyard show {c.name}.toml
# What its first ten cases draw:      marsyard show {c.name}.toml --draw 10
name = {json.dumps(c.name)}
scenario = {json.dumps(scenario)}
description = {json.dumps(about)}
# 230 cases without a failure show a probability of 0.99 with a confidence of 0.90. Choose the number before the first
# run: a campaign that has been judged needs more (marsyard append).
cases = {c.cases}
# The same seed gives the same cases, one by one, on any machine of this kind.
seed = 1

# ----- Parameters: whatever is not stated has its default (marsyard show lists them all) -----
"""


def _detector(c: Choices, otherwise: str = "") -> str:
    if not c.detector:
        return otherwise
    return f"""# Your detector, from its datasheet; what is stated beside the file goes before it.
[parameters.detector]
file = {json.dumps(c.detector)}
"""


def _dispersions(*lines: str) -> str:
    return "\n".join(
        [
            "# ----- Dispersions: what every case draws anew; each says where its distribution is from -----",
            "[dispersions]",
            *(line for line in lines if line),
            "",
        ]
    )


def _line(path: str, distribution: str, source: str) -> str:
    return f'"{path}" = {{ {distribution}, source = {json.dumps(source)} }}'


def _uniform(path: str, low: float, high: float, source: str) -> str:
    return _line(path, f'distribution = "uniform", low = {low!r}, high = {high!r}', source)


def _bank(cases: int) -> int:
    """Terrains to take in turn: one for each case, and for those appended. Only terrains that cases use are built."""
    return min(MOST_TERRAINS, max(FEWEST_TERRAINS, cases))


def _terrains(table: str) -> str:
    each = "each case has a terrain of its own, so that cases are independent"
    return _line(f"{table}.terrain", f'distribution = "in-turn", low = 0, high = "{table}.bank - 1"', each)


def _requirement(name: str, statement: str, metric: str, bound: float | None, probability: float, whom: str) -> str:
    bounded = "" if bound is None else f"bound = {bound!r}\n"
    return f"""# ----- Requirements: shown with this probability and confidence, or not -----
[[requirements]]
id = {json.dumps(name)}
statement = {json.dumps(statement)}
# A column of the results, and the most that it may be.
metric = {json.dumps(metric)}
{bounded}probability = {probability!r}
confidence = 0.90
# Cases that count: those in which an answer was given.
population = {json.dumps(whom)}
"""


def _velocity(c: Choices) -> list[str]:
    flown = (
        "" if c.flight else "the papers' descents: pictures near 2000, 1700 and 1400 m, 75 m/s, up to 30 m/s of wind"
    )
    parts = [
        f"""[parameters]
# Terrain, rocks, light and gravity: `marsyard terrain list`.
site = {json.dumps(c.site)}

# 4 km of ground, 2 m apart; finer and larger terrains take longer to build and more disk.
[parameters.terrain]
samples = 2048
spacing_m = 2.0

# Terrains, which cases take in turn. Cases that share a terrain count as one where the verdict counts terrains. Only
# those that cases use are built.
[parameters.place]
bank = {_bank(c.cases)}
"""
    ]
    if c.camera:
        parts.append(f"# Your camera, mounted to look down.\n[parameters.camera]\nmodel = {json.dumps(c.camera)}\n")
    one_row = "# Every row of your camera is read by itself.\n[parameters.detector]\nrows_summed = 1\n"
    parts.append(_detector(c, one_row if c.camera else ""))
    if c.camera:
        size = binned_size_for(*_delivered(c.camera))
        parts.append(
            f"# DIMES works on pictures binned to about 256 columns.\n[parameters.dimes]\nbinned_size = {list(size)}\n"
        )
    if c.flight:
        parts.append(f"""# Your trajectory, in place of the dynamics; positions count from the ground at `place`.
[parameters.flight]
file = {json.dumps(c.flight)}
# World axes of the file: enu (east, north, up) or ned.
axes = {json.dumps(c.axes)}
# Whose axes its quaternions turn into the world's: the camera's (x right, y down, z forward), or our body's.
attitude_of = "camera"
# The file's time of the first picture is lead_s after its beginning, unless first_picture_s says otherwise.
lead_s = 5.0
""")
    motion = [
        _line(
            "descent.altitude_first_m",
            'distribution = "normal", mean = 2000.0, sd = 30.0, truncate = [1900.0, 2100.0]',
            flown,
        ),
        _line(
            "descent.descent_rate_m_s", 'distribution = "normal", mean = 75.0, sd = 3.0, truncate = [65.0, 85.0]', flown
        ),
        _uniform("descent.wind_east_m_s", -21.2, 21.2, flown),
        _uniform("descent.wind_north_m_s", -21.2, 21.2, flown),
        _uniform("descent.cone_angle_deg", 0.0, 30.0, "coning at up to 30 deg from nadir (field test paper, III.C)"),
        _uniform("descent.cone_direction_deg", 0.0, 360.0, "any azimuth"),
        _uniform("descent.nod_rate_deg_s", 0.0, 60.0, "rates up to 60 deg/s (field test paper, III.C)"),
        _uniform("descent.heading_deg", 0.0, 360.0, "any heading"),
    ]
    parts.append(
        _dispersions(
            _terrains("place"),
            _uniform("place.east_m", 0.0, 4096.0, "anywhere on the terrain"),
            _uniform("place.north_m", 0.0, 4096.0, "anywhere on the terrain"),
            _uniform("sun.azimuth_deg", 230.0, 310.0, "afternoon, as both MER landings"),
            _uniform("sun.elevation_deg", 30.0, 60.0, "afternoon, as both MER landings"),
            *([_uniform("flight.turn_deg", 0.0, 360.0, "any heading")] if c.flight else motion),
        )
    )
    statement = f"The horizontal velocity that is reported is within {c.bound:g} m/s of the true one."
    parts.append(_requirement("VELOCITY", statement, "velocity_error_m_s", c.bound, 0.99, "valid"))
    return [part for part in parts if part]


def _delivered(camera: str) -> tuple[int, int]:
    """Columns and rows of a camera's pictures. Raises CampaignError where the file holds none."""
    try:
        return read_camera(camera).size
    except CameraFileError as error:
        raise CampaignError(str(error)) from error


def _landing(c: Choices) -> list[str]:
    camera = f"\n# Your camera, mounted to look down.\ncamera = {json.dumps(c.camera)}" if c.camera else ""
    parts = [
        f"""[parameters]
# Ground, rocks and light: `marsyard terrain list`.
site = {json.dumps(c.site)}{camera}

# 102 m of ground, 5 cm apart.
[parameters.terrain]
samples = 2048

# Terrains, which cases take in turn. Cases that share a terrain count as one where the verdict counts terrains. Only
# those that cases use are built.
[parameters.place]
bank = {_bank(c.cases)}
""",
        _detector(c),
        """# The lander: what it can stand on.
[parameters.lander]
diameter_m = 2.0
max_slope_deg = 15.0
max_roughness_m = 0.2

[parameters.hda]
check_footprints = true
lander_diameter_m = 2.0
max_roughness_m = 0.2
""",
        _dispersions(
            _terrains("place"),
            _uniform("place.east_m", 0.0, 102.4, "anywhere on the terrain"),
            _uniform("place.north_m", 0.0, 102.4, "anywhere on the terrain"),
            _uniform("sun.azimuth_deg", 90.0, 270.0, "from morning to afternoon"),
            _uniform("sun.elevation_deg", 30.0, 65.0, "assumed"),
            _uniform("flown.height_m", 8.0, 15.0, "assumed"),
            _uniform("flown.heading_deg", 0.0, 360.0, "any heading"),
            _uniform("flown.tilt_deg", 0.0, 5.0, "assumed"),
        ),
        _requirement(
            "SAFE",
            f"The chosen site is truly safe in {c.bound:g} of the cases in which one is reported.",
            "site_safe",
            None,
            c.bound,
            "site_reported",
        ),
    ]
    return [part for part in parts if part]


def _tracking(c: Choices) -> list[str]:
    return [
        f"""# Ground, rocks and light: `marsyard terrain list`. Cases take the bank's terrains in turn. Those sharing a
# terrain count as one where the verdict counts terrains. Only terrains that cases use are built.
[parameters.world]
site = {json.dumps(c.site)}
bank = {_bank(c.cases)}

# A stereo pair on a mast: mer-navcam, research-navcam or research-pancam.
[parameters.camera]
preset = "research-navcam"

# 10 m from the target's rock, then towards it in steps of a tenth of what remains, down to 2 m.
[parameters.start]
distance_m = 10.0

[[parameters.legs]]
motion = "approach"
step_share = 0.1
goal_m = 2.0
""",
        _dispersions(
            _terrains("world"),
            _uniform("target.yaw_deg", -180.0, 180.0, "any turn"),
            _uniform("target.across", -0.5, 0.5, "off the rock's edges; spread assumed"),
            _uniform("target.up", 0.35, 0.7, "off the rock's edges; spread assumed"),
            _uniform("target.diameter_m", 0.5, 1.5, "rocks that hold the template at 10 m"),
            _uniform("start.bearing_deg", 0.0, 360.0, "any direction"),
            _line(
                "sun.azimuth_deg",
                'distribution = "uniform", low = "start.bearing_deg - 80", high = "start.bearing_deg + 80"',
                "the sun behind the rover",
            ),
            _uniform("sun.elevation_deg", 25.0, 65.0, "assumed: working hours"),
            _uniform("slip.full_slope_deg", 20.0, 45.0, "from dry sand to firm ground"),
        ),
        _requirement(
            "POSITION",
            f"At the goal the reported position is within {c.bound:g} m of the designated point, in the rover frame.",
            "position_error_m",
            c.bound,
            0.95,
            "valid and selectable",
        ),
    ]
