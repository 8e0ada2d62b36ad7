"""Arrays of a run for its figures.

Figures are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import numpy as np

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.updates import update_quantities


def run_products(p: RoverScenarioParameters, run: RoverRun) -> dict[str, object]:
    """Collect the arrays for a run's figures (Figs. 15, 16b and 17 of the paper).

    ================== ================================================================================================
    stop_N_left        counts of the left subframe of stop N (from 1); `stop_N_right`: those of the right subframe
    stop_N_corners     full-frame (u, v) of the upper left pixels of both subframes, (2, 2)
    stop_N_window      search window in the left frame: (u, v) of its upper left pixel, columns, rows; or NaN
    stop_N_matches     tracked (u, v) in the left and the right frame, (2, 2); NaN if not tracked
    stop_N_point       (u, v) of the designated point's true projection in the left frame
    template_px        side of the template around `stop_N_matches`
    figures            arrays over the stops by name, see `update_quantities`
    states             the tracker's state at each stop
    rover_true_m       world positions of the rover's origin, (stops, 3); `rover_estimated_m`: estimated positions
    heading_deg        true azimuth of the rover at each stop, clockwise from north
    target_m           designated point, world, (3,); `target_estimated_m`: its estimated world position at each stop,
                       (stops, 3), NaN if not tracked
    path_true_m        world positions of the rover's origin along its path, (points, 2)
    rocks_m            east, north and diameter of the target's rock and the obstacles, (rocks, 3)
    ================== ================================================================================================
    """
    stops, rocks, rock_indices = run.stops, run.setup.world.rocks, list(run.setup.world.rocks.names.values())
    arrays: dict[str, object] = {}
    for number, stop in enumerate(stops, start=1):
        left, right, details = stop.images.left, stop.images.right, stop.details
        window, matched_px = np.full(4, np.nan), np.full((2, 2), np.nan)
        if details is not None and details.window is not None and details.window_corner is not None:
            window = np.array([*details.window_corner, *details.window.shape[::-1]], dtype=np.float64)
        matched_px[0] = stop.reported_px(run.setup.rig.calibrated)
        if details is not None and details.stereo is not None and stop.update.tracked:
            matched_px[1] = details.stereo.pixel
        stop_arrays = {
            "left": left.counts,
            "right": right.counts,
            "corners": np.array([left.corner, right.corner], dtype=np.float64),
            "window": window,
            "matches": matched_px,
            "point": stop.point_px,
        }
        arrays |= {f"stop_{number}_{name}": values for name, values in stop_arrays.items()}
    estimated_targets = [
        np.full(3, np.nan)
        if stop.reported_position_rover is None
        else stop.estimated_pose.apply(stop.reported_position_rover.copy())
        for stop in stops
    ]
    stances = [stance for stop in stops for drive in stop.drives for stance in drive.stances]
    path = [stance.world_from_rover.translation[:2] for stance in stances]
    arrays |= {
        "template_px": p.vtt.template_px,
        "figures": update_quantities(run),
        "states": [stop.update.state.name for stop in stops],
        "rover_true_m": np.array([stop.stance.world_from_rover.translation for stop in stops]).reshape(-1, 3),
        "rover_estimated_m": np.array([stop.estimated_pose.translation for stop in stops]).reshape(-1, 3),
        "heading_deg": np.degrees(np.array([stop.stance.azimuth_rad for stop in stops])),
        "target_m": run.target.point_world,
        "target_estimated_m": np.array(estimated_targets).reshape(-1, 3),
        "path_true_m": np.array(path).reshape(-1, 2),
        "rocks_m": np.column_stack([rocks.position_m[rock_indices, :2], rocks.diameter_m[rock_indices]]),
    }
    return arrays
