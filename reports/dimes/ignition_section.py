"""Section on the velocity error at the ignition of the thrusters.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from marsyard.reports.blocks import Quantity, quantile_block
from marsyard.reports.empty_cells import omit_empty_rows
from marsyard.reports.section import Block, Grid, Section, Subject, create_section, has_values
from marsyard.reports.tables import error_summaries, statistics_rows

_FIRING = "firing_velocity_error_m_s"
_FIRING_NOTE = (
    "The first column is the magnitude of the error. The reported velocity is a mean over the time between images 2 "
    "and 3. The IMU propagates it to ignition. The error is the difference from the true velocity of the camera at "
    "ignition, which includes the pendulum motion. It can be smaller than in the section Errors: an attitude error "
    "causes errors of opposite sign in the reported velocity and in the propagation."
)


def ignition_section(subject: Subject) -> Section | None:
    """Create the section on the error of the propagated velocity at thruster ignition, at a height near 100 m.

    Section I of the paper. None without the error, or if it is the page's metric.
    """
    frame = subject.frame
    if subject.metric == _FIRING or not has_values(frame, _FIRING):
        return None
    summaries = error_summaries(frame, _FIRING)
    rows, too_few_cases = omit_empty_rows(statistics_rows([summary for _, summary in summaries]))
    grid = Grid(["", *(name for name, _ in summaries)], rows)
    return create_section(
        "firing",
        "Ignition",
        "Velocity error at thruster ignition",
        Block(grid=grid, note=f"{too_few_cases}{_FIRING_NOTE}", data=dict(summaries)),
        quantile_block(
            frame,
            [Quantity("firing_after_s")],
            {"Minimum": 0.0, "Median": 0.5, "Maximum": 1.0},
            "Time available to compute the velocity",
        ),
    )
