"""Every number of the target tracker that could have been another one, with why it is what it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marsyard.algorithms.image.registration import Warp


@dataclass(frozen=True)
class VttOptions:
    """Options of the visual target tracker (paper: sections 4 and 5 of 'Targeted Driving Using Visual Tracking').

    - template_px: Side of the template, odd (paper: 21, "it provided the best result for natural rock images")
    - search_px: Side of the search window, full-frame pixels (paper: 161; 200 and 600 in section 5.2)
    - scale, roll: Whether the template is magnified (Eq. 6) and rolled (Eqs. 7 to 10) before it is matched. Without
      both this is the paper's pure NCC.
    - roll_lever_m: Distance k of the hypothetical point beside the target (paper: 5 cm, "arbitrary, small")
    - coarse_levels: How often template and window are halved for the coarse search; 0 searches all places at full
      resolution
    - coarse_candidates: Local maxima of the coarse correlation that are followed to full resolution
    - subpixel: Whether the matches, left and right, are refined below a pixel (the paper does not say that VTT did).
      Every step's error is magnified by all later steps: 16 steps from 10 m to 2 m turn 0.3 px, the error of whole
      pixels, into 3 px.
    - warp: What the refinement solves for besides the place: nothing (``shift``), a stretch of the picture
      (``stretch``), or a quadratic bend too (``bend``). The paper's tracker did not; approaching a slanted surface
      stretches the picture and approaching a round one, seen ever more from above, bends it: a match by less leans the
      same way at each step (docs/adr/0010). The score stays that of the shifted template.
    - epipolar_tolerance_px: How far from the epipolar curve the right picture is searched (paper: 2, default)
    - stereo_search_share: Disparities searched, as a share of `search_px`, about that of the predicted range (paper:
      one half)
    - seed_range_m: Least and largest range of a target given by a pixel: its first stereo search covers all between
    - aim_pair: Whether the mast centres the target between the two cameras rather than in the left one (the paper's
      way). A pancam at 2 m sees 512 px of disparity: with the target in the middle of the left picture it leaves the
      right.
    - min_match_score, min_stereo_score: Least NCC of the match and of point stereo (paper: 0.7, "set empirically")
    - stereo_disparity_error_px: Disparity error of 3 sigma in the tolerances (paper: 1 pixel)
    - pose_error: Error of the estimated position in the tolerances, as a share of the distance driven. 0.2 lets wheels
      slip by as much, as on gentle slopes: a right match is not given up for what the wheels lost. Visual odometry
      needs less (paper: "roughly 2%"), steep ground without it more, up to 1.
    - direction_error_rad: Error of the direction to the target, from attitude and mast, in the tolerance of the
      position: 1.7 deg
    - tolerance_floor_m: Part of both tolerances that does not depend on distance: relief under a drifting match, mast
      pointing
    - max_lost_updates: Updates in a row, after the one that lost the target, in which it may be found again (paper: N,
      default 2)
    """

    template_px: int = 21
    search_px: int = 161
    scale: bool = True
    roll: bool = True
    roll_lever_m: float = 0.05
    coarse_levels: int = 1
    coarse_candidates: int = 6
    subpixel: bool = True
    warp: Warp = "bend"
    epipolar_tolerance_px: float = 2.0
    stereo_search_share: float = 0.5
    seed_range_m: tuple[float, float] = (1.0, 100.0)
    aim_pair: bool = False
    min_match_score: float = 0.7
    min_stereo_score: float = 0.7
    stereo_disparity_error_px: float = 1.0
    pose_error: float = 0.2
    direction_error_rad: float = 0.03
    tolerance_floor_m: float = 0.05
    max_lost_updates: int = 2

    def __post_init__(self) -> None:
        if self.template_px < 5 or self.template_px % 2 == 0:
            raise ValueError(f"template_px is {self.template_px}; it must be odd and at least 5")
        if self.search_px < self.template_px + 2:
            raise ValueError(f"search_px is {self.search_px}; it must exceed template_px ({self.template_px}) by 2")
        if self.coarse_levels < 0 or self.template_px >> self.coarse_levels < 2:
            raise ValueError(
                f"coarse_levels is {self.coarse_levels}; from 0 on, and a template of {self.template_px} pixels must "
                "keep 2 of them after as many halvings"
            )
        if self.coarse_candidates < 1:
            raise ValueError(f"coarse_candidates is {self.coarse_candidates}; it must be at least 1")
        if self.max_lost_updates < 0:
            raise ValueError(f"max_lost_updates is {self.max_lost_updates}; it must not be negative")
        if not 0.0 < self.seed_range_m[0] < self.seed_range_m[1]:
            raise ValueError(f"seed_range_m is {self.seed_range_m}; it must be two ranges above 0, the least first")
        for name in ("roll_lever_m", "epipolar_tolerance_px", "stereo_search_share"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")

    @property
    def disparity_search_px(self) -> float:
        """Disparities searched on each side of the predicted one, pixels."""
        return 0.5 * self.stereo_search_share * self.search_px


#: The paper's baseline: normalised correlation of the template as it was cut (section 5.1).
PURE_NCC = VttOptions(scale=False, roll=False, warp="shift")
