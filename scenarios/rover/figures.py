"""Arrays and timeline of a rover's run, for its figures in the report and the exports of `marsyard replay`."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun, Stop
from marsyard.scenarios.rover.score import update_quantities
from marsyard.scenarios.timeline import CameraPose, Path, Series, TimedImage, TimedPoints, Timeline
from marsyard.scenarios.timeline_surface import surface_from_above
from marsyard.scenarios.views import Viewpoint, site_scene
from marsyard.sim.render import Scene

#: Margin of the shown ground around the run and the target, m.
_MARGIN_M = 2.0
#: Quantities of the updates that are no values over time.
_NO_SERIES = ("leg", "time_s")


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


def run_timeline(p: RoverScenarioParameters, run: RoverRun) -> Timeline:
    """Create the timeline of a run: images and answers at the stops, true and estimated path."""
    stops, target_m = run.stops, run.target.point_world
    true_path, positions = _true_path(stops), np.array([stop.stance.world_from_rover.translation for stop in stops])
    horizontal = np.concatenate([positions.reshape(-1, 3), true_path.positions_m, target_m[None]])[:, :2]
    low, high = horizontal.min(axis=0), horizontal.max(axis=0)
    centre, half_width_m = 0.5 * (low + high), 0.5 * float((high - low).max()) + _MARGIN_M

    def create_scene(east_m: float, north_m: float, height_m: float, pixel_rad: float) -> Scene:
        return site_scene(
            run.setup.world.ground, Viewpoint(east_m, north_m, height_m, pixel_rad), run.setup.world.scene(0.0).sun
        )

    tracked = [stop for stop in stops if stop.reported_position_rover is not None]
    quantities = update_quantities(run)
    return Timeline(
        surfaces={"ground": surface_from_above(create_scene, (centre[0], centre[1]), half_width_m, p.backend)},
        paths={
            "true": true_path,
            "estimated": Path.from_poses([stop.time_s for stop in stops], [stop.estimated_pose for stop in stops]),
        },
        images=[image for stop in stops for image in _images(run, stop, p.vtt.template_px)],
        points={
            "target": TimedPoints.permanent(target_m),
            "tracked target": TimedPoints(
                np.array([stop.time_s for stop in tracked], dtype=np.float64),
                # the reported position, seen from the true rover
                np.array([_reported_m(stop) for stop in tracked], dtype=np.float64).reshape(-1, 3),
            ),
        },
        series={
            name.replace("_", " "): Series(quantities["time_s"], values)
            for name, values in quantities.items()
            if name not in _NO_SERIES and np.isfinite(values).any()
        },
    )


def _reported_m(stop: Stop) -> np.ndarray:
    """Return the reported target position, world, from the true pose of the rover."""
    return np.asarray(stop.stance.world_from_rover.apply(np.array(stop.reported_position_rover)))


def _true_path(stops: list[Stop]) -> Path:
    """Return the true poses of the rover; the poses between two stops have equal time steps."""
    times: list[float] = []
    poses: list[RigidTransform] = []
    for number, stop in enumerate(stops):
        stances = [stance for drive in stop.drives for stance in drive.stances]
        start_s = stops[number - 1].time_s if number else 0.0
        times += np.linspace(start_s, stop.time_s, len(stances) + 1)[:-1].tolist()
        poses += [stance.world_from_rover for stance in stances]
        times.append(stop.time_s)
        poses.append(stop.stance.world_from_rover)
    return Path.from_poses(times, poses)


def _images(run: RoverRun, stop: Stop, template_px: float) -> list[TimedImage]:
    """Return the subframes of a stop; the tracked template and the search window are marked in the left one."""
    images = []
    details, rig = stop.details, run.setup.rig
    for name, camera, image in (("left", rig.left, stop.images.left), ("right", rig.right, stop.images.right)):
        corner = np.array(image.corner, dtype=np.float64)
        subframe = camera.crop(*image.corner, image.counts.shape[::-1])
        point_px = np.asarray(
            camera.project(np.asarray(stop.world_from_head.inv().apply(run.target.point_world.copy())))[0]
        )
        marks, boxes = {"target": (point_px - corner).reshape(1, 2)}, {}
        if name == "left":
            tracked_px = stop.reported_px(rig.calibrated) - corner
            marks["tracked target"] = tracked_px.reshape(1, 2)
            boxes["template"] = np.array([[*(tracked_px - 0.5 * template_px), template_px, template_px]])
            if details is not None and details.window is not None and details.window_corner is not None:
                upper_left = np.asarray(details.window_corner, dtype=np.float64) - corner - 0.5  # of a pixel's centre
                boxes["search window"] = np.array([[*upper_left, *details.window.shape[::-1]]], dtype=np.float64)
        pose = CameraPose.from_camera(subframe, stop.world_from_head)
        bits = run.setup.camera.bits
        images.append(TimedImage(f"{name} camera", stop.time_s, image.counts, bits, pose, marks, boxes))
    return images
