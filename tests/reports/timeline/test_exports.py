"""Tests of the exports of timelines: the files are read back by other packages, or by the library's own reader."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.campaigns.store.products import pack_products, unpack_products
from marsyard.reports.timeline.figure import draw_timeline
from marsyard.reports.timeline.glb import write_glb
from marsyard.reports.timeline.mesh import camera_outlines, triangulate
from marsyard.scenarios.timeline import PRODUCT, CameraPose, SurfacePatch, Timeline, timeline_products
from marsyard.scenarios.timeline import Path as TimelinePath
from marsyard.scenarios.timeline_recording import recording_timelines
from marsyard.sim.camera import Cahvore
from tests.reports.timeline.timeline_example import CENTRE_M, make_camera, make_image, make_timeline


def test_timeline_survives_storage_as_products() -> None:
    timeline = make_timeline()
    stored = Timeline.from_products(unpack_products(pack_products({PRODUCT: timeline.to_products()})))
    np.testing.assert_equal(stored.to_products(), {**timeline.to_products(), "images": stored.to_products()["images"]})
    for read, written in zip(stored.images, timeline.images, strict=True):
        np.testing.assert_equal(vars(read.pose), vars(written.pose))
        np.testing.assert_equal({**vars(read), "pose": None}, {**vars(written), "pose": None})
    assert Timeline.from_products({"image_1": np.zeros((2, 2))}) is None


def test_camera_pose_projects_as_its_camera() -> None:
    """A pinhole camera with the pose's rotation, focal lengths and centre has the same pixels as the CAHV camera."""
    camera = make_camera().bin(columns=1, rows=2)
    world_from_body = RigidTransform.from_components(
        np.array([10.0, -20.0, 300.0]), Rotation.from_euler("ZYX", [40.0, 10.0, -8.0], degrees=True)
    )
    pose = CameraPose.from_camera(camera, world_from_body)
    points = np.array([[0.0, 0.0, 0.0], [50.0, -60.0, 5.0], [-40.0, 30.0, 0.0]])
    local = Rotation.from_quat(pose.quaternion_xyzw).inv().apply(points - pose.position_m)
    pixels = local[:, :2] / local[:, 2:] * pose.focal_px + pose.centre_px
    expected, in_front = camera.transform(world_from_body).project(points)
    assert in_front.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    assert pose.distortion.size == 0


def test_distortion_is_in_camera_axes() -> None:
    cahv = make_camera()
    camera = Cahvore.from_cahv(cahv, r=np.array([0.01, 0.02, 0.03]), e=np.zeros(3), linearity=0.4)
    pose = CameraPose.from_camera(camera, RigidTransform.from_rotation(Rotation.from_euler("z", 70.0, degrees=True)))
    np.testing.assert_allclose(pose.distortion, [0.0, 0.0, 1.0, 0.01, 0.02, 0.03, 0.0, 0.0, 0.0, 0.4], atol=1e-12)


def test_missing_points_have_no_triangles() -> None:
    points = np.zeros((3, 3, 3), dtype=np.float32)
    points[..., 0], points[..., 1] = np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0, 2.0])
    patch = SurfacePatch(points, np.zeros((3, 3), dtype=np.uint8))
    assert len(triangulate(patch)) == 8
    points[1, 1] = np.nan
    assert len(triangulate(patch)) == 2  # the central point is a corner of six triangles
    assert not (triangulate(patch) == 4).any()


def test_camera_outline_surrounds_the_visible_ground() -> None:
    image = make_image(0.0, 90.0)
    edges = camera_outlines(image, 100.0)
    assert edges.shape == (8, 2, 3)
    np.testing.assert_allclose(edges[:4, 0], np.tile([*CENTRE_M, 90.0], (4, 1)))
    # the upper left corner of the image is north-west of the centre, below the camera
    corner = edges[0, 1] - edges[0, 0]
    assert corner[0] < 0.0 < corner[1]
    assert corner[2] < 0.0


def test_glb_contains_the_case(tmp_path: Path) -> None:
    write_glb(tmp_path / "case.glb", make_timeline())
    scene = trimesh.load(tmp_path / "case.glb", force="scene", process=False)
    assert {"ground", "map", "path true", "path estimated", "descent camera, image 1"} <= set(scene.geometry)
    origin = np.array(scene.metadata["origin_m"])
    np.testing.assert_allclose(origin[:2], CENTRE_M, atol=1.0)
    # y of glTF is up: the world's (east, north, up) is (x, -z, y)
    transform, name = scene.graph["path true"]
    points = trimesh.transform_points(scene.geometry[name].vertices, transform)
    world = points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0]) + origin
    np.testing.assert_allclose(world[0], [*CENTRE_M, 100.0], atol=1e-3)
    ground = scene.geometry["ground"]
    assert len(ground.faces) == 200 - 2  # both triangles of the missing corner's cell
    rotation = scene.graph["ground"][0][:3, :3]
    assert ((ground.face_normals @ rotation.T)[:, 1] > 0.9).all()  # visible from above


def test_figure_shows_the_case() -> None:
    figure = draw_timeline(make_timeline())
    axes: Any = figure.axes[0]
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts == ["true path", "estimated path", "cameras", "touchdown", "target"]
    assert axes.get_zlim()[1] >= 90.0


def test_ros_bag_is_read_back(tmp_path: Path) -> None:
    """The reader of rosbags returns the images, calibration, poses and inertial data of the timeline."""
    from rosbags.highlevel import AnyReader

    from marsyard.reports.timeline.ros_bag import write_ros_bag

    timeline = make_timeline()
    write_ros_bag(tmp_path / "bag", timeline)
    with AnyReader([tmp_path / "bag"]) as reader:
        messages: dict[str, list[tuple[int, Any]]] = {}
        for connection, stamp_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append((stamp_ns, message))
    assert sorted(messages) == [
        "/camera/descent_camera/camera_info", "/camera/descent_camera/image_raw", "/camera/descent_camera/pose",
        "/imu", "/pose/estimated", "/pose/true", "/tf",
    ]  # fmt: skip
    (first_ns, image), (second_ns, _) = messages["/camera/descent_camera/image_raw"]
    assert (first_ns, second_ns) == (10**9, 2 * 10**9)  # the first time of the case is -1 s
    assert (image.encoding, image.header.stamp.sec) == ("mono16", 1)
    counts = image.data.view("<u2").reshape(image.height, image.width)
    np.testing.assert_array_equal(counts, timeline.images[0].counts)
    info = messages["/camera/descent_camera/camera_info"][0][1]
    focal, centre = timeline.images[0].pose.focal_px, timeline.images[0].pose.centre_px
    np.testing.assert_allclose(info.k, [focal[0], 0, centre[0], 0, focal[1], centre[1], 0, 0, 1])
    assert info.distortion_model == "plumb_bob"
    pose = messages["/pose/true"][2][1].pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (*CENTRE_M, 80.0)
    frames = {item.child_frame_id for _, message in messages["/tf"] for item in message.transforms}
    assert frames == {"body", "descent_camera_optical"}
    imu = messages["/imu"][0][1]
    assert (imu.angular_velocity.x, imu.linear_acceleration.z) == (0.1, 3.7)
    assert "start_s: '-1.0'" in (tmp_path / "bag" / "metadata.yaml").read_text()


def test_case_that_ended_at_its_start_is_exported(tmp_path: Path) -> None:
    """A rover whose mast cannot point at the target has no path, no images and no values."""
    from marsyard.reports.timeline.ros_bag import write_ros_bag

    full = make_timeline()
    empty = TimelinePath(np.empty(0), np.empty((0, 3)), np.empty((0, 4)))
    points = {"target": full.points["target"]}
    timeline = Timeline({"ground": full.surfaces["ground"]}, {"true": empty, "estimated": empty}, [], points)
    assert len(draw_timeline(timeline).axes) == 1
    write_glb(tmp_path / "case.glb", timeline)
    write_ros_bag(tmp_path / "bag", timeline)


def test_timeline_of_another_version_is_ignored() -> None:
    stored = make_timeline().to_products()
    assert Timeline.from_products({PRODUCT: {**stored, "paths": {"true": {"times_s": np.zeros(1)}}}}) is None
    assert Timeline.from_products({PRODUCT: {"surfaces": {}}}) is None


def test_exception_of_a_timeline_does_not_affect_the_case() -> None:
    def fail() -> Timeline:
        raise IndexError("no such image")

    with recording_timelines():
        products = timeline_products(fail)
        assert timeline_products(fail, is_tested=False) == {}
    assert products == {PRODUCT: "IndexError: no such image"}
    assert Timeline.from_products(products) is None


@pytest.mark.slow
def test_rerun_file_is_verified(tmp_path: Path) -> None:
    """The tools of Rerun verify the recording and print its entities."""
    from marsyard.reports.timeline.rerun_file import write_rerun

    path = tmp_path / "case.rrd"
    write_rerun(path, make_timeline(), "case 1")
    printed = run_rerun("print", "-vv", path)
    run_rerun("verify", path)
    for entity in (
        "/world/surfaces/ground", "/world/surfaces/map", "/world/paths/true/body", r"/world/cameras/descent\ camera",
        r"/world/cameras/descent\ camera/tracks", r"/world/estimates/estimated\ position", "/world/points/touchdown",
        r"/series/altitude\,\ m", r"/inertial/rate\,\ rad\/s/x",
    ):  # fmt: skip
        assert entity in printed


def run_rerun(command: str, *arguments: object) -> str:
    """Run a command of Rerun for recordings; return its output."""
    program = Path(sys.executable).parent / "rerun"
    finished = subprocess.run(
        [program, "rrd", command, *map(str, arguments)], capture_output=True, text=True, check=True, timeout=60
    )
    return finished.stdout
