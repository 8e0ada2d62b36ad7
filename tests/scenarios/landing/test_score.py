"""Tests of the score of a flight's answer against known ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaDetails, Matches, MatchStatus
from marsyard.algorithms.hda.motion import View
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.engine import check_metrics
from marsyard.scenarios.conformance.parts import swinging_fall
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import GroundTruth
from marsyard.scenarios.landing.relief import Footprints, Limits, Relief
from marsyard.scenarios.landing.score import landing_row, site_populations, site_row, stage_row
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor import preset
from marsyard.sim.streams import Streams

SAFE_SITE, UNSAFE_SITE = np.array([-3.0, 0.0, 0.0]), np.array([3.0, 0.0, 0.0])
REPORTED, REFUSED = SiteOutcome.SAFE_SITE, SiteOutcome.NO_SAFE_SITE


def make_flight() -> Flight:
    """A flight with exact navigation."""
    states = swinging_fall().state(0.0), swinging_fall().state(3.75)
    first, second = (PoseMeasurement(rigid(one.attitude, one.position_m), one.time_s) for one in states)
    return Flight(states, (first, second), np.array([0.0, 0.0, 1.0]))


def make_truth(safe_places: int) -> GroundTruth:
    """Return 12 m of ground, level in the west and too steep in the east, on a lattice of 1 m. The given number of
    safe positions is at the centre. A square of 5 x 5 has one position with a margin of one lander radius; three in
    a row have none.
    """
    x, _ = np.meshgrid(np.arange(-6.0, 6.0, 0.1), np.arange(-6.0, 6.0, 0.1))
    line = np.linspace(-4.0, 4.0, 9)
    places_m = np.stack(np.meshgrid(line, line), axis=-1)
    safe = np.zeros(places_m.shape[:2], dtype=bool)
    if safe_places == 25:
        safe[2:7, 2:7] = True
    else:
        safe[4, 3 : 3 + safe_places] = True
    static = np.zeros(safe.shape)
    footprints = Footprints(static, static, static, safe)
    return GroundTruth(
        Relief(np.maximum(x, 0.0), -6.0, -6.0, 0.1), Limits(2.0, 0.26, 0.2), places_m, footprints, safe | True, 1.0
    )


@pytest.mark.parametrize(
    ("safe_places", "population"), [(0, "no_safe_site_exists"), (3, "narrow_site_exists"), (25, "wide_site_exists")]
)
def test_each_flight_is_in_one_population(safe_places: int, population: str) -> None:
    row = site_populations(make_truth(safe_places))
    populations = ("no_safe_site_exists", "narrow_site_exists", "wide_site_exists")
    assert [name for name in populations if row[name]] == [population]


@pytest.mark.parametrize(
    ("outcome", "site", "is_correct"),
    [
        (REPORTED, SAFE_SITE, True),
        (REPORTED, UNSAFE_SITE, False),
        (REFUSED, None, True),
        # The a-priori site stays if the algorithm does not converge; it is safe by chance.
        (SiteOutcome.NO_MOTION, SAFE_SITE, False),
    ],
)
def test_safe_site_or_refusal_is_correct(outcome: SiteOutcome, site: np.ndarray | None, is_correct: bool) -> None:
    row = site_row(SiteEstimate(outcome, site), make_flight(), make_truth(3))
    assert row["safe_or_no_site_reported"] is is_correct


def test_flight_without_landing_has_no_touchdown_score() -> None:
    p, streams = LandingScenarioParameters(), Streams(1, "landing", 0)
    row = landing_row(p, SiteEstimate(REFUSED, None), make_flight(), make_truth(3), streams)
    assert row["landed"] is False
    assert "touchdown_safe" not in row
    # A first case without a landing does not stop a campaign with touchdown requirements.
    check_metrics(load_campaign("hda-benign").configuration, {**row, "answered": True}, Path())


def test_each_hazardous_population_has_a_requirement() -> None:
    requirements = load_campaign("hda-hazardous").configuration.requirements
    populations = {one.population for one in requirements}
    assert {"no_safe_site_exists", "narrow_site_exists", "wide_site_exists"} <= populations
    (narrow,) = [one for one in requirements if one.population == "narrow_site_exists"]
    # The verdict uses confidence: "met" needs a confidence bound.
    assert (narrow.metric, narrow.decide_by) == ("safe_or_no_site_reported", "confidence")


def test_matches_are_counted_by_outcome() -> None:
    statuses = np.repeat(np.array(list(MatchStatus), dtype=np.uint8), [50, 4, 3, 2])
    pixels, nothing = np.zeros((59, 2)), np.zeros(59)
    matches = Matches(pixels, pixels, pixels, pixels, nothing, nothing, statuses, np.zeros((50, 3)))
    camera = preset("xc-55").cameras()[0]
    view = View(np.zeros((480, 640), dtype=np.uint16), camera, rigid(Rotation.identity(), np.zeros(3)))
    row = stage_row(HdaDetails((view, view), matches=matches))
    assert row == {
        "points": 50,
        "matched_fraction": 50 / 59,
        "matches_dissimilar": 4,
        "matches_out_of_bounds": 3,
        "matches_not_returned": 2,
    }
