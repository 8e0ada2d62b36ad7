"""Times of the images of a landing."""

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.scenarios.localisation.instruments import INERTIAL_MARGIN_S
from marsyard.sim.parameters import Parameters, bounded_field


class ImageSchedule(Parameters):
    """Times of the images: those of the coarse stage first (0.3 Hz, Mars 2020), then those of the fine stage.

    Mars 2020 took up to one image per second in the fine stage; the default of 0.5 Hz is assumed.
    """

    first_s: Annotated[float, bounded_field(INERTIAL_MARGIN_S, 60.0, "first image, after the start")] = 0.5
    coarse_images: Annotated[int, Field(ge=0, le=100, description="images of the coarse stage")] = 3
    coarse_interval_s: Annotated[float, bounded_field(0.1, 60.0, "time after each image of the coarse stage")] = 3.3
    interval_s: Annotated[float, bounded_field(0.1, 60.0, "time between images of the fine stage")] = 2.0

    def times(self, start_s: float, end_s: float) -> Float64[np.ndarray, "images"]:
        """Compute the nominal times of the images from start to end (included)."""
        first, coarse = start_s + self.first_s, self.coarse_interval_s * np.arange(self.coarse_images + 1)
        count = max(int((end_s - first - coarse[-1]) / self.interval_s) + 1, 0)
        times = np.concatenate([first + coarse[:-1], first + coarse[-1] + self.interval_s * np.arange(count)])
        return np.asarray(times[times <= end_s])
