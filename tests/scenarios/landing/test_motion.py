"""What a motion and its structure rest on, in columns."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import Fate, HdaDetails, Matches
from marsyard.algorithms.hda.view import View
from marsyard.scenarios.landing.score import solved_row
from marsyard.sim.frames import rigid
from marsyard.sim.sensor import preset


def test_every_match_is_counted_by_what_became_of_it() -> None:
    fates = np.repeat(np.array(list(Fate), dtype=np.uint8), [50, 4, 3, 2])
    pixels, nothing = np.zeros((59, 2)), np.zeros(59)
    matches = Matches(pixels, pixels, pixels, pixels, nothing, nothing, fates, np.zeros((50, 3)))
    camera = preset("xc-55").cameras()[0]
    view = View(np.zeros((480, 640), dtype=np.uint16), camera, rigid(Rotation.identity(), np.zeros(3)))
    row = solved_row(HdaDetails((view, view), matches=matches))
    assert row == {
        "points": 50,
        "matched_fraction": 50 / 59,
        "matches_dissimilar": 4,
        "matches_out_of_bounds": 3,
        "matches_not_returned": 2,
    }
