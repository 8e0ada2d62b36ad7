"""The error of a velocity after the inertial unit has carried it on to the thrusters' firing near 100 m (section I)."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from marsyard.reports.columns import label, numbers
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid, statistics_grid
from marsyard.reports.tables import error_summaries
from marsyard.reports.wording import number

METRIC = "firing_velocity_error_m_s"
#: Time from the last picture to the firing: what DIMES and the computer have for their answer.
AVAILABLE = "firing_after_s"


def carried_section(subject: Subject) -> Section | None:
    """Statistics of the error at the firing; None where no row has one."""
    frame = subject.frame
    if subject.metric == METRIC or not np.isfinite(numbers(frame, METRIC)).any():
        return None
    blocks = [Block(grid=statistics_grid(frame, METRIC))]
    available = numbers(frame, AVAILABLE)
    available = available[np.isfinite(available)]
    note = (
        "The velocity reported is the mean over the second pair of pictures. The inertial unit adds its change until "
        "the firing; the error is held against the camera's true velocity there, swinging included."
    )
    if available.size:
        texts = [number(float(value)) for value in (available.min(), np.median(available), available.max())]
        grid = Grid(["", "Least", "Median", "Greatest"], [[label(AVAILABLE), *texts]])
        blocks.append(Block(heading="Time from the last picture to the firing", grid=grid))
    data = {name: asdict(one) for name, one in error_summaries(frame, METRIC)}
    return Section("firing", "Firing", "Error when the thrusters fire", [*blocks, Block(note=note)], data)
