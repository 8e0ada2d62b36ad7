"""What a tracking update keeps for figures and diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

from marsyard.algorithms.vtt.loss import Evidence, Tolerances
from marsyard.algorithms.vtt.matching import Change, Match
from marsyard.algorithms.vtt.stereo import StereoMatch


@dataclass(frozen=True)
class VttDetails:
    """One update, found or not; what the paper's Figs. 15 and 17 and Table III show.

    Attributes
    ----------
    seeded
        Whether this update took the first template rather than looked for one.
    predicted_pixel
        Where the target was expected in the left picture, full-frame (u, v), shape (2,); None where it cannot be seen.
    window, window_corner
        The search window of the left picture, counts, and the full-frame (u, v) of its upper left pixel; None with
        `predicted_pixel`.
    change
        Magnification and roll since the last sighting (computed also where the options leave them out of the match);
        None at the seed and where the target cannot be seen.
    match
        The left match with the template as searched for; None where there was no room for it.
    template
        The new picture about the match, cut at the sub-pixel position: the next template as it is now.
    stereo
        The right match; None without a left one, or without room.
    distance_m
        From the left camera to the target, metres: triangulated, or predicted where it was not.
    azimuth_rad
        Direction from the left camera to the target in the rover frame, positive to the right, radians.
    azimuth_change_rad
        By how much the direction in the world has turned since the last sighting, positive to the right, radians:
        what changes the target's appearance (a turn in place changes nothing).
    position_world
        The target in the world as estimated, metres, shape (3,); None where it was not triangulated.
    step_m
        How far the rover moved since the last sighting by its pose estimate, metres.
    evidence, allowed
        What the criteria judged and the tolerances they used; None at the seed and where something was missing.
    """

    seeded: bool
    predicted_pixel: Float[np.ndarray, "2"] | None
    window: UInt16[np.ndarray, "rows columns"] | None = None
    window_corner: tuple[int, int] | None = None
    change: Change | None = None
    match: Match | None = None
    template: Float[np.ndarray, "n n"] | None = None
    stereo: StereoMatch | None = None
    distance_m: float = float("nan")
    azimuth_rad: float = float("nan")
    azimuth_change_rad: float = 0.0
    position_world: Float[np.ndarray, "3"] | None = None
    step_m: float = 0.0
    evidence: Evidence | None = None
    allowed: Tolerances | None = None
