"""Which cases of a campaign are runs that track a target."""

import pandas as pd

from marsyard.reports import populations

#: Columns of all rows of tracking cases.
_TRACKING_COLUMNS = ("tracked", "drift_px", "position_error_m", "losses")


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether the rows are those of tracking cases."""
    return {*_TRACKING_COLUMNS} <= {*frame}


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether the tracker guides the rover; in other campaigns, many targets are tracked in the same images."""
    return is_tracking(frame) and "step" not in frame


def selectable_targets(frame: pd.DataFrame, face: bool = True) -> pd.DataFrame:
    """Select rows with selectable targets: sunlit, in both images to the end, not on the rock's edge.

    In shared drives, whose path does not depend on the tracker, the rover's shadow is never on the target. With `face`,
    the target is also on the rock's face, where the campaign defines it.
    """
    names = ["selectable", "in_view", *(["on_face"] if face else [])]
    if "step" in frame:
        names.append("no_rover_shadow_on_target")
    return frame[populations.all_flags(frame, *names)]
