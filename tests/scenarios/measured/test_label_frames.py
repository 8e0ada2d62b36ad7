"""Tests of the frames of camera models: each pose of a label is applied once, and camera files name their frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.exchange.files import write_case
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.layout import IngestError
from marsyard.scenarios.measured.store import CasesFile, load_images, write_camera
from marsyard.sim.camera import BODY_FRAME, Cahvor, CameraModel, read_cahvor, read_camera, write_cahvor
from marsyard.sim.frames import SITE_FROM_WORLD, world_from_mars_fixed
from tests.sim.camera.labels import SITE_FROM_ROVER, pds3_label

WORLD_FROM_SITE = RigidTransform.from_rotation(SITE_FROM_WORLD.inv())
#: A rover near Jezero: its z axis points along the local down direction.
MARS_POSITION = np.array([701403.2, 3145680.62, 1075894.36])
MARS_FROM_ROVER = world_from_mars_fixed(MARS_POSITION).inv() * WORLD_FROM_SITE


@pytest.fixture
def small_camera() -> Cahvor:
    """Return a camera of 32 x 32 pixels in the rover's frame, looking forward and 30 deg down."""
    a = np.array([np.cos(0.5), 0.0, np.sin(0.5)])
    h = 40.0 * np.array([0.0, 1.0, 0.0]) + 15.5 * a
    v = 40.0 * np.array([-np.sin(0.5), 0.0, np.cos(0.5)]) + 15.5 * a
    return Cahvor(np.array([0.5, -0.2, -1.3]), a, h, v, a, np.zeros(3), (32, 32))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "folder"
    folder.mkdir()
    return folder


def write_folder(folder: Path, lines: list[str], parameters: str = "") -> None:
    (folder / "ingest.toml").write_text(f'name = "frames"\ntask = "matching"\n{parameters}[detector]\nbits = 8\n')
    (folder / "images.csv").write_text("\n".join(lines) + "\n")


def ingest_cameras(folder: Path, target: Path) -> list[CameraModel]:
    """Ingest a folder; return the cameras of its first case in world axes."""
    target.mkdir()
    path, stored = ingest(folder, target)
    images = load_images(CasesFile(file=str(path)), stored.cases[0])
    poses = stored.cases[0].images
    return [
        image.camera.transform(RigidTransform.from_components(np.array(pose.position_m), pose.pose.rotation))
        for image, pose in zip(images, poses, strict=True)
    ]


def ingest_models(
    tmp_path: Path, models: list[CameraModel], frame: str, reference: str | None, pose: RigidTransform
) -> list[CameraModel]:
    folder = tmp_path / "folder"
    folder.mkdir()
    for number, model in enumerate(models):
        pds3_label(folder, model, frame, reference, pose, name=f"{number}.img", clock=100.0 + number)
    write_folder(folder, ["case,file", *(f"a,{number}.img" for number in range(len(models)))])
    return ingest_cameras(folder, tmp_path / "out")


def assert_poses_agree(camera: CameraModel, expected: CameraModel, atol_m: float = 1e-5) -> None:
    assert np.allclose(camera.c, expected.c, rtol=0.0, atol=atol_m)
    assert np.allclose(camera.a, expected.a, rtol=0.0, atol=1e-6)
    assert np.allclose(camera.h, expected.h, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("frame", "frame_from_rover", "reference"),
    [
        ("ROVER_FRAME", RigidTransform.identity(), "SITE_FRAME"),
        ("SITE_FRAME", SITE_FROM_ROVER, "SITE_FRAME"),
        ("SITE_FRAME", SITE_FROM_ROVER, None),
        ("LOCAL_LEVEL_FRAME", RigidTransform.from_rotation(SITE_FROM_ROVER.rotation), "SITE_FRAME"),
    ],
)
def test_every_frame_gives_the_same_camera_in_the_world(
    tmp_path: Path, small_camera: Cahvor, frame: str, frame_from_rover: RigidTransform, reference: str | None
) -> None:
    model = small_camera.transform(frame_from_rover)
    first, second = ingest_models(tmp_path, [model, model], frame, reference, SITE_FROM_ROVER)
    assert_poses_agree(first, small_camera.transform(WORLD_FROM_SITE * SITE_FROM_ROVER))
    assert_poses_agree(second, first)


@pytest.mark.parametrize("reference", ["MCMF_FRAME", None])
def test_mars_fixed_models_are_in_the_first_image_frame(
    tmp_path: Path, small_camera: Cahvor, reference: str | None
) -> None:
    """The second camera is 30 m above the first, and rotated by 0.1 rad about the vertical."""
    step = RigidTransform.from_components([0.0, 0.0, -30.0], Rotation.from_rotvec([0.0, 0.0, 0.1]))
    rover_cameras = [small_camera, small_camera.transform(step)]
    models: list[CameraModel] = [camera.transform(MARS_FROM_ROVER) for camera in rover_cameras]
    first, second = ingest_models(tmp_path, models, "MCMF_FRAME", reference, MARS_FROM_ROVER)
    assert_poses_agree(
        second.transform(RigidTransform.from_translation(-first.c)),
        rover_cameras[1].transform(
            RigidTransform.from_rotation(SITE_FROM_WORLD.inv()) * RigidTransform.from_translation(-small_camera.c)
        ),
        atol_m=1e-4,
    )
    if reference is None:
        assert np.allclose(first.c, 0.0, atol=1e-6)


def test_models_in_a_fixed_frame_are_refused_for_poses_of_the_table(
    tmp_path: Path, folder: Path, small_camera: Cahvor
) -> None:
    pds3_label(folder, small_camera.transform(MARS_FROM_ROVER), "MCMF_FRAME", None, name="0.img")
    write_folder(
        folder,
        ["case,file,time_s,qx,qy,qz,qw", *(f"a,0.img,{time},0,0,0,1" for time in (0, 1))],
        '[poses]\naxes = "enu"\nattitude_of = "body"\n[camera]\npose_in_file = true\n',
    )
    with pytest.raises(IngestError, match=r"line 2: .*0.img: the camera model is in the frame MCMF_FRAME"):
        ingest(folder, tmp_path / "out")


def test_camera_file_of_another_size_than_the_product_is_refused(
    tmp_path: Path, folder: Path, small_camera: Cahvor
) -> None:
    pds3_label(folder, small_camera, "ROVER_FRAME", name="0.img")
    write_cahvor(replace(small_camera, size=(24, 32)), folder / "other.cahvor", frame=BODY_FRAME)
    write_folder(
        folder,
        ["case,file,camera,time_s,qx,qy,qz,qw", *(f"a,0.img,other.cahvor,{time},1,0,0,0" for time in (0, 1))],
        '[poses]\naxes = "enu"\nattitude_of = "camera"\n',
    )
    with pytest.raises(IngestError, match=r"line 2: .*0.img: has 32 x 32 pixels; its camera has 24 x 32"):
        ingest(folder, tmp_path)


@pytest.mark.parametrize("other", ["SITE_FRAME", "table"])
def test_a_case_has_one_frame(tmp_path: Path, folder: Path, small_camera: Cahvor, other: str) -> None:
    pds3_label(folder, small_camera.transform(MARS_FROM_ROVER), "MCMF_FRAME", None, name="0.img")
    pds3_label(folder, small_camera, "ROVER_FRAME", name="1.img", clock=101.0)
    quaternion = ",,," if other == "SITE_FRAME" else "1,0,0,0"
    write_folder(
        folder,
        ["case,file,qx,qy,qz,qw", "a,0.img,,,,", f"a,1.img,{quaternion}"],
        '[poses]\naxes = "enu"\nattitude_of = "camera"\n',
    )
    with pytest.raises(IngestError, match=r"line 3: the pose is in .*; allowed: one frame in a case"):
        ingest(folder, tmp_path / "out")


def test_positions_of_the_table_need_its_attitudes(tmp_path: Path, folder: Path, small_camera: Cahvor) -> None:
    for number in (0, 1):
        pds3_label(folder, small_camera, "ROVER_FRAME", name=f"{number}.img", clock=100.0 + number)
    write_folder(folder, ["case,file,x_m,y_m,z_m", "a,0.img,0,0,0", "a,1.img,5,0,0"], '[poses]\naxes = "enu"\n')
    with pytest.raises(IngestError, match="line 2: x_m, y_m, z_m are given, but qx to qw are not"):
        ingest(folder, tmp_path / "out")


def test_poses_in_different_sites_are_refused(tmp_path: Path, folder: Path, small_camera: Cahvor) -> None:
    pds3_label(folder, small_camera, "ROVER_FRAME", name="0.img")
    path = pds3_label(folder, small_camera, "ROVER_FRAME", name="1.img", clock=101.0)
    path.write_bytes(path.read_bytes().replace(b"SYSTEM_INDEX = 194\n", b"SYSTEM_INDEX = 195\n"))
    write_folder(folder, ["case,file", "a,0.img", "a,1.img"])
    with pytest.raises(IngestError, match=r"line 3: .*SITE_FRAME \(195,\), that of the case's first image .*194"):
        ingest(folder, tmp_path / "out")


def test_separate_camera_file_is_in_the_rover_frame(tmp_path: Path, folder: Path, small_camera: Cahvor) -> None:
    product = pds3_label(folder, small_camera.transform(SITE_FROM_ROVER), "SITE_FRAME", name="0.img")
    pds3_label(folder, small_camera, "ROVER_FRAME", name="1.img", clock=101.0)
    write_cahvor(read_camera(product), folder / "left.cahvor")
    write_folder(folder, ["case,file,camera", "a,0.img,left.cahvor", "a,1.img,"])
    first, second = ingest_cameras(folder, tmp_path / "out")
    assert_poses_agree(first, second)


def test_exported_and_ingested_cameras_name_the_body_frame(tmp_path: Path) -> None:
    measurements = inputs.descent()
    write_case(tmp_path, measurements)
    write_camera(tmp_path, 0, measurements.images[0].camera)
    exported_file, ingested_file = tmp_path / "camera_1.cahvor", tmp_path / "cameras" / "000000.cahvor"
    for path in (exported_file, ingested_file):
        assert path.read_text().startswith(f"# Frame: {BODY_FRAME}\n")
        assert read_cahvor(path) == measurements.images[0].camera
