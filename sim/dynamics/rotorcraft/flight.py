"""Flying a small helicopter: over the ground for pictures, then to a site and down onto it (landing paper, V).

Thrust acts along the body's z axis, drag in proportion to the speed through the air, so that it pitches forward to fly
and leans into the wind. Pitch, roll and yaw follow the autopilot's commands as second-order systems and yield to gusts;
thrust follows with a lag. The autopilot commands speed by distance, acceleration by speed, and tilt by acceleration,
with a trim against steady wind, on the state a little earlier.

The flight for pictures is flown on true states: how far off its path it is matters to nobody. The landing is flown on
what is believed, so that navigation's errors become errors of the touchdown; below the height of the flare it only
stops its drift, and gusts carry it off.

Left out: the inflow near the ground, sliding or tipping after the touchdown (the skids stay where they first touch
and level out), and any wind that depends on place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import scipy  # its signal is slow to import, and so left until it is called
from jaxtyping import Float64, Int64

from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.dynamics.rotorcraft.kernels import CARRIED, PLACE, SIZE, THRUST
from marsyard.sim.dynamics.rotorcraft.parameters import (
    AirParameters,
    LandingGuidance,
    RotorcraftParameters,
    TransitParameters,
)
from marsyard.sim.dynamics.rotorcraft.path import FlownPath, Vibration

#: How long after the last picture the flight for pictures ends, s: clocks may be late.
TAIL_S = 0.1


@dataclass(frozen=True)
class Air:
    """The wind over a span of time: its mean, and gusts at the knots of the simulation from the flight's start on."""

    mean_m_s: Float64[np.ndarray, "3"]
    gusts_m_s: Float64[np.ndarray, "knots 3"]

    @classmethod
    def drawn(cls, parameters: AirParameters, step_s: float, duration_s: float, rng: np.random.Generator) -> Air:
        """Wind for a duration; the gusts' process is stationary."""
        p = parameters
        kept = np.exp(-step_s / p.correlation_s)
        shocks = rng.standard_normal((int(np.ceil(duration_s / step_s)) + 2, 3))
        shocks[1:] *= np.sqrt(1.0 - kept**2)
        sizes = np.array([p.gust_m_s, p.gust_m_s, p.vertical_gust_m_s])
        return cls(
            np.array([p.east_m_s, p.north_m_s, 0.0]), sizes * scipy.signal.lfilter([1.0], [1.0, -kept], shocks, axis=0)
        )

    def check_lasts(self, knots: int) -> None:
        """Raises ValueError where there are gusts for fewer knots than a flight may take."""
        if len(self.gusts_m_s) < knots:
            raise ValueError(f"there are gusts for {len(self.gusts_m_s)} knots; the flight may take {knots}")


@dataclass(frozen=True)
class GroundPatch:
    """Heights of the ground about a site, bilinear within and held beyond.

    Attributes
    ----------
    corner_m
        East and north of the first height.
    spacing_m
        Distance between heights.
    heights_m
        Row i lies at north + i * spacing, column j at east + j * spacing.
    """

    corner_m: Float64[np.ndarray, "2"]
    spacing_m: float
    heights_m: Float64[np.ndarray, "rows columns"]

    def height_m(self, place_m: Float64[np.ndarray, "2"]) -> float:
        """Height at a place (east, north)."""
        return float(kernels.ground_height(self.as_kernel(), float(place_m[0]), float(place_m[1])))

    def as_kernel(self) -> kernels.Ground:
        """As the kernels take it."""
        east, north = self.corner_m.tolist()
        return kernels.Ground(east, north, self.spacing_m, self.heights_m)


@dataclass(frozen=True)
class LandingLaser:
    """The altimeter as the landing uses it.

    Attributes
    ----------
    scale
        Readings over true ranges.
    noise_m
        Of the reading at each knot from the flight's start on.
    stuck_m
        What it reads always, if it does.
    """

    scale: float
    noise_m: Float64[np.ndarray, "knots"]
    stuck_m: float | None = None


class Phase(Enum):
    """What a flight is about; the values are those of the kernels."""

    TRANSIT = kernels.FOLLOW
    WAIT = kernels.WAIT
    APPROACH = kernels.APPROACH
    DESCENT = kernels.DESCEND
    LANDING = kernels.FLARE
    ON_GROUND = kernels.REST


@dataclass(frozen=True)
class RotorcraftFlight:
    """A flight, and what it takes to fly on.

    Attributes
    ----------
    path
        The motion.
    phases
        What it was about at each knot: values of `Phase`.
    carried
        Thrust and trim at the last knot.
    heading_rad
        Yaw that is held.
    craft
        The helicopter.
    """

    path: FlownPath
    phases: Int64[np.ndarray, "knots"]
    carried: Float64[np.ndarray, "4"]
    heading_rad: float
    craft: RotorcraftParameters

    def first(self, phase: Phase) -> float | None:
        """Time at which a phase began; None if it did not."""
        found = np.flatnonzero(self.phases == phase.value)
        return float(self.path.knots_s[found[0]]) if found.size else None


def transit_flight(
    craft: RotorcraftParameters,
    transit: TransitParameters,
    over_m: Float64[np.ndarray, "3"],
    course_rad: float,
    heading_rad: float,
    gravity_m_s2: float,
    air: Air,
    rng: np.random.Generator,
) -> RotorcraftFlight:
    """The flight up to a moment after the last picture.

    Parameters
    ----------
    over_m
        Where it is commanded to be at the first picture.
    course_rad, heading_rad
        Directions of flight and nose, counterclockwise from east.
    rng
        Phases of the vibration.

    Raises
    ------
    ValueError
        If the air is known for less than the flight takes, `TAIL_S` after the last picture included.
    """
    p, step = transit, craft.step_s
    count = int(np.ceil((p.lead_s + p.pictures_s + TAIL_S) / step - 1e-9)) + 1
    air.check_lasts(count)
    times = -p.lead_s + step * np.arange(count)
    along = np.array([np.cos(course_rad), np.sin(course_rad), 0.0])
    reference = np.concatenate([np.multiply.outer(one, along) for one in _run_up(p, times)], axis=1)
    reference[:, :3] += over_m
    constants = craft.craft(gravity_m_s2)
    rows = np.zeros((count, SIZE))
    rows[0, PLACE : PLACE + 3] = reference[0, :3]
    rows[0, kernels.ANGLE :][:3], carried = _trimmed(constants, heading_rad, air.mean_m_s)
    kernels.follow(kernels.Flight(rows, carried, heading_rad, air.mean_m_s, air.gusts_m_s, step), reference, constants)
    path = FlownPath(-p.lead_s, step, rows, Vibration.drawn(craft.vibration, rng), gravity_m_s2)
    return RotorcraftFlight(path, np.full(count, Phase.TRANSIT.value), carried, heading_rad, craft)


def landing_flight(
    flown: RotorcraftFlight,
    guidance: LandingGuidance,
    site_m: Float64[np.ndarray, "2"],
    errors: Float64[np.ndarray, "m 9"],
    air: Air,
    ground: GroundPatch,
    laser: LandingLaser,
    end_s: float | None = None,
) -> RotorcraftFlight:
    """The flight on to a site and down, until `end_s`, or else `rest_s` after the touchdown or when the time is up.

    Parameters
    ----------
    flown
        The flight for pictures.
    site_m
        East and north of the site in the coordinates that are believed.
    errors
        Believed less true position, velocity and angles (yaw, pitch, roll) at the knots from the flight's start on; the
        last row is held after them.

    Raises
    ------
    ValueError
        If the air or the laser's noise is known for less than the flight may take.
    """
    step, before = flown.craft.step_s, len(flown.path.rows)
    count = before + int(np.ceil((guidance.wait_s + guidance.longest_s) / step))
    air.check_lasts(count)
    if len(laser.noise_m) < count:
        raise ValueError(f"the laser's noise is known for {len(laser.noise_m)} knots; the flight may take {count}")
    rows = np.concatenate([flown.path.rows, np.zeros((count - before, SIZE))])
    phases = np.concatenate([flown.phases, np.full(count - before, Phase.WAIT.value)])
    held = np.concatenate([errors, np.repeat(errors[-1:], max(count - len(errors), 0), axis=0)])
    hover_m = float(rows[before - 1, 2] + held[before - 1, 2])
    wait_until = before - 1 + round((guidance.wait_s - TAIL_S) / step)
    flight = kernels.Flight(rows, flown.carried.copy(), flown.heading_rad, air.mean_m_s, air.gusts_m_s, step)
    kernels.land(
        flight,
        phases,
        before - 1,
        held,
        laser.noise_m,
        ground.as_kernel(),
        _landing_commands(guidance, site_m, hover_m, wait_until, laser),
        flown.craft.craft(flown.path.gravity_m_s2),
    )
    landed = np.flatnonzero(phases == Phase.ON_GROUND.value)
    if end_s is not None:
        count = min(count, round((end_s - flown.path.start_s) / step) + 1)
    elif landed.size:
        count = min(count, int(landed[0]) + int(np.ceil(guidance.rest_s / step)))
    path = replace(flown.path, rows=rows[:count])
    return replace(flown, path=path, phases=phases[:count], carried=flight.carried)


def _landing_commands(
    guidance: LandingGuidance, site_m: Float64[np.ndarray, "2"], hover_m: float, wait_until: int, laser: LandingLaser
) -> kernels.Landing:
    return kernels.Landing(
        site_east_m=float(site_m[0]),
        site_north_m=float(site_m[1]),
        hover_m=hover_m,
        wait_until=wait_until,
        approach_m_s=guidance.approach_m_s,
        near_m=guidance.near_m,
        descent_m_s=guidance.descent_m_s,
        flare_range_m=guidance.flare_range_m,
        flare_m_s=guidance.flare_m_s,
        laser_scale=laser.scale,
        laser_stuck_m=np.nan if laser.stuck_m is None else laser.stuck_m,
    )


def _run_up(
    p: TransitParameters, times_s: Float64[np.ndarray, "n"]
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Distance along the course from where the first picture is due, speed and acceleration of the commanded point."""
    ramp = p.speed_m_s / p.acceleration_m_s2
    since = times_s + p.settle_s + ramp
    gaining = np.clip(since, 0.0, ramp)
    distance = 0.5 * p.acceleration_m_s2 * gaining**2 + p.speed_m_s * (np.maximum(since, ramp) - ramp)
    distance -= 0.5 * p.speed_m_s * ramp + p.speed_m_s * p.settle_s
    return distance, p.acceleration_m_s2 * gaining, np.where((since > 0.0) & (since < ramp), p.acceleration_m_s2, 0.0)


def _trimmed(
    c: kernels.Craft, heading_rad: float, wind_m_s: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "4"]]:
    """Angles at which it hovers in this wind, and what is carried then."""
    trim = -wind_m_s / c.drag_s
    east, north, _ = trim.tolist()
    forward = np.cos(heading_rad) * east + np.sin(heading_rad) * north
    left = np.cos(heading_rad) * north - np.sin(heading_rad) * east
    pitch = np.arctan2(forward, c.gravity_m_s2)
    roll = -np.arctan2(left * np.cos(pitch), c.gravity_m_s2)
    carried = np.zeros(CARRIED)
    carried[THRUST] = np.sqrt(c.gravity_m_s2**2 + trim @ trim)
    carried[kernels.TRIM :] = trim
    return np.array([heading_rad, pitch, roll]), carried
