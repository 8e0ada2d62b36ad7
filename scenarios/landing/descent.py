"""From the answer to the ground: the helicopter flies to the site that it was given, and lands on it."""

from __future__ import annotations

import numpy as np

from marsyard.algorithms.interface import SiteEstimate
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.faults import stuck_range_m
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.helicopter import Touchdown, land
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.score import place_row
from marsyard.scenarios.landing.truth import GroundTruth
from marsyard.sim.dynamics.rotorcraft import GroundPatch
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams

NAN = float("nan")


def landing_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: Flight, truth: GroundTruth, streams: Streams
) -> dict[str, Scalar]:
    """Where the helicopter came down, and what the ground is like there.

    `touchdown_error_gps_m` is the distance of the receiver's averaged solutions from the site's coordinates, as the
    paper measured it; `touchdown_error_m` that of the true touchdown from where these coordinates led it, the error of
    the navigation at the first picture taken off; `touchdown_safe` whether it stands safely, `touchdown_sink_m_s` and
    `touchdown_drift_m_s` how fast it came down and went sideways. Without a site, or in a
    case that states its pair and flies no helicopter, there is no landing: numbers are NaN, and `touchdown_safe` is
    absent, as nothing stands anywhere.
    """
    landed = _landed(p, estimate, flight, truth, streams)
    if landed is None or estimate.site_world is None:
        nowhere = place_row("touchdown", None, truth)
        del nowhere["touchdown_safe"]
        return {"landed": False, **nowhere, **dict.fromkeys(_NUMBERS, NAN)}
    place = landed.state.position_m
    site = estimate.site_world
    numbers = (
        landed.gps_error_m(site),
        landed.believed_error_m(site),
        landed.true_error_m(site - flight.position_error_m),
        float(landed.gps_deviation_m[1]),
        float(landed.gps_deviation_m[0]),
        landed.gps_solutions,
        landed.turns,
        landed.moved_m,
        landed.time_s - flight.states[1].time_s,
        -float(landed.state.velocity_m_s[2]),
        float(np.hypot(*landed.state.velocity_m_s[:2])),
    )
    return {"landed": True, **place_row("touchdown", place[:2], truth), **dict(zip(_NUMBERS, numbers, strict=True))}


_NUMBERS = (
    "touchdown_error_gps_m",
    "touchdown_error_believed_m",
    "touchdown_error_m",
    "gps_deviation_north_m",
    "gps_deviation_east_m",
    "gps_solutions",
    "landing_turns",
    "landing_moved_m",
    "landing_after_s",
    "touchdown_sink_m_s",
    "touchdown_drift_m_s",
)


def _landed(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: Flight, truth: GroundTruth, streams: Streams
) -> Touchdown | None:
    if flight.transit is None or estimate.site_world is None:
        return None
    relief = truth.relief
    ground = GroundPatch(np.array([relief.west_m, relief.south_m]), relief.spacing_m, relief.heights_m)
    unit = RangingUnit.drawn(p.laser, streams.generator("laser"))
    return land(flight.transit, estimate.site_world, ground, unit, streams, stuck_range_m(p.faults, p.height_m))
