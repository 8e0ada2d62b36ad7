"""Registration of a template that may have been shifted, stretched and bent: Gauss-Newton on quintic splines.

Shifting alone leans: where the picture is longer one way than the template, texture that is denser on one side pulls
the match to that side, by up to tenths of a pixel. Solving for the stretch as well takes that out. Of a round surface
seen from another height the picture bends: its middle moves otherwise than its border does on the mean, always to the
same side, and solving for the bend takes that out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.image.alignment import SURROUND, spline_coefficients
from marsyard.algorithms.image.kernels import registration as kernels

#: What a template may have undergone: a shift; a linear map too; a quadratic map of its offsets too.
Warp = Literal["shift", "stretch", "bend"]
_ORDERS: dict[Warp, int] = {"shift": 0, "stretch": 1, "bend": 2}
#: A step below this, pixels, ends the iteration; what is left is less than 1e-3 px.
TOLERANCE = 3e-3
#: A pivot of the normal equations, their diagonal made 1, below which texture does not tell one unknown from another.
SINGULAR = 1e-4


@dataclass(frozen=True)
class Limits:
    """How far a registration may go before it is not believed.

    Attributes
    ----------
    shift_px
        Largest distance of the middle from where it started.
    stretch
        Largest entry of the linear map's difference from the identity, and of the bend at the template's border.
    steps
        Steps allowed; four to six are the rule.
    """

    shift_px: float = 1.5
    stretch: float = 0.35
    steps: int = 12


#: What is believed where nothing else is said.
LIMITS = Limits()


@dataclass(frozen=True)
class Registration:
    """Where a template matches best.

    Attributes
    ----------
    corner
        Row and column of its upper left pixel in the window, as if it were only shifted, shape (2,).
    score
        Normalised correlation of the template with what it was registered to.
    """

    corner: Float[np.ndarray, "2"]
    score: float


@dataclass(frozen=True)
class SplinedPart:
    """The part of a window about a template's place, as a spline.

    Attributes
    ----------
    near, far
        Its first row and column, and those after its last.
    coefficients
        Of the quintic spline.
    """

    near: tuple[int, int]
    far: tuple[int, int]
    coefficients: Float[np.ndarray, "rows columns"]


def splined(
    window: Float[np.ndarray, "rows columns"],
    corner: Float[np.ndarray, "2"],
    side: int,
    known: SplinedPart | None = None,
) -> SplinedPart:
    """The spline about a template of `side` pixels with its upper left one at `corner` (row, column).

    What is `known` of the same window is given back where it is the same part.
    """
    first = np.maximum(np.floor(corner).astype(int) - SURROUND, 0)
    last = np.ceil(corner).astype(int) + side + SURROUND
    near, far = (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))
    if known is not None and (known.near, known.far) == (near, far):
        return known
    return SplinedPart(near, far, spline_coefficients(window[near[0] : far[0], near[1] : far[1]]))


def registered(
    template: Float[np.ndarray, "n n"],
    window: Float[np.ndarray, "rows columns"] | SplinedPart,
    corner: Float[np.ndarray, "2"],
    warp: Warp,
    limits: Limits = LIMITS,
) -> Registration | None:
    """The place in the window, or in the part of it about `corner`, at which the template matches best, by its middle.

    Minimises ``sum (B(c + M d + Q(d)) - gain A(d) - offset)^2`` over the middle c, gain, offset and, as `warp` allows,
    the matrix M, which else is 1, and the quadratic form Q, which else is 0; A is the template over offsets d from its
    middle, B the window by quintic splines. It goes from `corner` (row, column) by the inverse compositional method
    (Baker & Matthews 2004): derivatives are those of the template, taken once. None when it leaves the limits or the
    window, does not converge, or when the texture does not determine the unknowns.
    """
    half = 0.5 * (len(template) - 1)
    part = window if isinstance(window, SplinedPart) else splined(window, corner, len(template))
    near = np.array(part.near)
    start = corner - near + half
    bounds = (limits.shift_px, limits.stretch, limits.steps)
    done, row, column, score = kernels.register(
        template, part.coefficients, start[0], start[1], _ORDERS[warp], bounds, TOLERANCE, SINGULAR
    )
    return Registration(np.array([row, column]) - half + near, score) if done else None
