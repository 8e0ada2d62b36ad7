"""Cases as points in standard normal space: their coordinates, and the number of their random streams.

Studies (`marsyard.campaigns.studies`) choose the points of their cases. Each random dispersion is a function of one
standard normal variable: its inverse distribution at Phi(z), after the correlation of its group. The random streams of
a case (noise of the instruments, for example) have no coordinates; a point selects them by a number.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.special import ndtr

from marsyard.campaigns.sampling.correlation import MAX_DRAW, MIN_DRAW, Correlation, correlate_groups
from marsyard.sim.streams import Blend

#: Column of stored rows that contains the point of the case, as text.
POINT_COLUMN = "standard_point"
#: Number of the new random streams of a case that is not yet run; they get the number of the case.
NEW_STREAM = -1


@dataclass(frozen=True)
class StudyPoint:
    """A case, stored or to be run, as a point in standard normal space.

    - coordinates: independent standard normal numbers of the random dispersions, in the order of the campaign file
    - stream: number of the random streams of the case (`marsyard.sim.streams`), or `NEW_STREAM`
    - nominal: paths of the dispersions that have the campaign's parameter instead of a sampled value
    - removed: names of the sources of error that the case does not have (`marsyard.scenarios.error_sources`)
    - blend: components of blended random streams, of which `stream` is the newest; empty for streams without blending
    - values: paths and values of parameters that replace those of the campaign, also sampled ones
    """

    coordinates: tuple[float, ...]
    stream: int = NEW_STREAM
    nominal: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    blend: Blend = ()
    values: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def read(cls, text: str) -> Self:
        """Read a point from its text. Raises ValueError for any other text."""
        try:
            coordinates, stream, nominal, removed, *present = json.loads(text)
            blend, values = [*present, [], []][:2]  # `text` omits them if they are empty
            return cls(
                tuple(map(float, coordinates)),
                int(stream),
                nominal=tuple(map(str, nominal)),
                removed=tuple(map(str, removed)),
                blend=tuple((int(number), float(weight)) for number, weight in blend),
                values=tuple((str(path), value) for path, value in values),
            )
        except (TypeError, ValueError) as error:
            raise ValueError(f"not a point of a study: {text!r:.100}") from error

    def with_numbers(self, case: int) -> StudyPoint:
        """Return the point as a case, whose number the new streams get."""
        stream = case if self.stream == NEW_STREAM else self.stream
        return replace(self, stream=stream, blend=number_blend(self.blend, case))

    @property
    def text(self) -> str:
        """The point as text, without loss of precision."""
        rest = [self.blend, self.values] if self.values else [self.blend] if self.blend else []
        return json.dumps([self.coordinates, self.stream, self.nominal, self.removed, *rest])


def number_blend(blend: Blend, case: int) -> Blend:
    """Give the new component of a blend of random streams the number of its case."""
    return tuple((case if number == NEW_STREAM else number, weight) for number, weight in blend)


def transform_to_uniform(
    coordinates: Sequence[float], paths: Sequence[str], correlations: Sequence[Correlation]
) -> dict[str, float]:
    """Transform independent standard normal numbers to the uniform numbers of the dispersions `paths`."""
    uniform = np.clip(ndtr(np.asarray(coordinates, dtype=np.float64)), MIN_DRAW, MAX_DRAW)
    return correlate_groups(dict(zip(paths, uniform.tolist(), strict=True)), correlations)
