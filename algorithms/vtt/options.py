"""Options of the target tracker, with the reasons for their defaults."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from marsyard.algorithms.image.registration import Warp


@dataclass(frozen=True)
class VttOptions:
    """Options of the visual target tracker (paper: sections 4 and 5 of 'Targeted Driving Using Visual Tracking').

    The defaults are the published algorithm, with assumed values where the paper gives none.

    - template_px: Side of the template, odd (paper: 21, "it provided the best result for natural rock images")
    - search_px: Side of the search window, full-frame pixels (paper: 161; 200 and 600 in section 5.2)
    - scale, roll: Whether the template is magnified (Eq. 6) and rolled (Eqs. 7 to 10) before it is matched. Without
      both this is the paper's pure NCC.
    - roll_lever_m: Distance k of the auxiliary point from the target, for the roll (paper: 5 cm, "arbitrary, small")
    - coarse_levels: Number of pyramid levels below full resolution; 0 searches all positions at full resolution
    - coarse_candidates: Number of local maxima of the coarse correlation that are refined at full resolution
    - subpixel: Whether the left and right matches are refined to sub-pixel accuracy (not specified in the paper). The
      following steps magnify the error of a step: with whole pixels, whose error is 0.3 px, 16 steps from 10 m to 2 m
      cause an error of 3 px.
    - warp: Refinement of the sub-pixel match by registration: none (``none``; a quadratic fit of the correlation peak
      only), a shift (``shift``), also an affine distortion (``stretch``), or also a quadratic distortion (``bend``).
      The paper's tracker had no warp: its authors removed an affine stage for reliability. In an approach, a slanted
      surface is distorted affinely and a round surface also quadratically. A simpler model has the same bias at each
      step (docs/adr/0010). The match score is that of the template without this distortion.
    - epipolar_tolerance_px: Search range perpendicular to the epipolar curve of the right image (paper: 2, default)
    - stereo_search_fraction: Range of searched disparities around the prediction, as a fraction of `search_px` (paper:
      one half)
    - seed_range_m: Smallest and largest range of a target designated by a pixel, for its first stereo search
    - aim_pair: Whether the mast centres the target between the two images instead of in the left image (as in the
      paper). A pancam has a disparity of 512 px at 2 m: a target centred in the left image is outside the right image.
    - min_match_score, min_stereo_score: Minimum NCC of the template match and of the stereo match (paper: 0.7, "set
      empirically")
    - stereo_disparity_error_px: 3-sigma disparity error in the tolerances (paper: 1 pixel)
    - pose_error: Error of the estimated position in the tolerances, as a fraction of the distance driven. 0.2 covers
      20 % wheel slip, typical of gentle slopes. With visual odometry a smaller value is sufficient (paper: "roughly
      2%"); on steep ground without visual odometry up to 1 is required.
    - direction_error_rad: Error of the direction to the target, from attitude and mast, in the tolerance of the
      position (default 1.7 deg)
    - min_tolerance_m: Constant term of the tolerances of distance and position: terrain relief around a drifted match,
      and mast pointing errors
    - max_lost_updates: Consecutive updates after a loss in which the target can be recovered (paper: N, default 2)
    """

    template_px: int = 21
    search_px: int = 161
    scale: bool = True
    roll: bool = True
    roll_lever_m: float = 0.05
    coarse_levels: int = 1
    coarse_candidates: int = 6
    subpixel: bool = True
    warp: Warp | Literal["none"] = "none"
    epipolar_tolerance_px: float = 2.0
    stereo_search_fraction: float = 0.5
    seed_range_m: tuple[float, float] = (1.0, 100.0)
    aim_pair: bool = False
    min_match_score: float = 0.7
    min_stereo_score: float = 0.7
    stereo_disparity_error_px: float = 1.0
    pose_error: float = 0.2
    direction_error_rad: float = 0.03
    min_tolerance_m: float = 0.05
    max_lost_updates: int = 2

    def __post_init__(self) -> None:
        if self.template_px < 5 or self.template_px % 2 == 0:
            raise ValueError(f"template_px is {self.template_px}; it must be odd and at least 5")
        if self.search_px < self.template_px + 2:
            raise ValueError(f"search_px is {self.search_px}; it must exceed template_px ({self.template_px}) by 2")
        if self.coarse_levels < 0 or self.template_px >> self.coarse_levels < 2:
            raise ValueError(
                f"coarse_levels is {self.coarse_levels}; it must be at least 0, and a template of {self.template_px} "
                "pixels must keep at least 2 pixels at the coarsest level"
            )
        if self.coarse_candidates < 1:
            raise ValueError(f"coarse_candidates is {self.coarse_candidates}; it must be at least 1")
        if self.max_lost_updates < 0:
            raise ValueError(f"max_lost_updates is {self.max_lost_updates}; it must not be negative")
        if not 0.0 < self.seed_range_m[0] < self.seed_range_m[1]:
            raise ValueError(f"seed_range_m is {self.seed_range_m}; it must be two positive ranges in ascending order")
        for name in ("roll_lever_m", "epipolar_tolerance_px", "stereo_search_fraction"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")

    @property
    def disparity_search_px(self) -> float:
        """Range of disparities searched on each side of the predicted disparity, pixels."""
        return 0.5 * self.stereo_search_fraction * self.search_px


#: The paper's baseline: normalised correlation of the unwarped template (section 5.1).
PURE_NCC = VttOptions(scale=False, roll=False)
#: Options of `vtt-plus` that differ from the published algorithm.
IMPROVEMENTS: Mapping[str, Any] = MappingProxyType({"warp": "bend"})
