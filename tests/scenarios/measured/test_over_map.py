"""Tests of images over a map: registration to a fraction of a pixel, matchers, outcomes, and clear errors."""

import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.measured import counterparts, store
from marsyard.scenarios.measured.columns import MAP_COLUMNS
from marsyard.scenarios.measured.counterparts import CounterpartParameters, render_counterpart
from marsyard.scenarios.measured.image_files import read_counts
from marsyard.scenarios.measured.map_matching import MATCHERS, MapComparison, compare_with_map
from marsyard.scenarios.measured.map_registration import load_map
from marsyard.scenarios.measured.over_map import OverMapScenario, pose_error_px
from marsyard.sim.camera import Cahvor, Cahvore, write_cahvor
from marsyard.sim.frames import rigid, world_from_mars_fixed
from marsyard.sim.streams import Streams
from tests.command import run_command
from tests.scenarios.measured.map_folders import CAMERA, POSES, ingest_map, map_scene, write_map, write_map_folder
from tests.sim.camera.labels import pds3_label

STREAMS = Streams(seed=1, campaign="flight", case=0)
#: Standard deviation of the position of a registered image, m: two pixels of the map.
POSITION_SD_M = 12.0


def compare(cases: store.CasesFile, number: int) -> MapComparison:
    """Compare an ingested image with the map of its folder."""
    case = cases.stored.cases[number]
    record, (image,) = case.images[0], store.load_images(cases, case)
    posed = PosedImage.from_detector(image, np.asarray(record.pose.translation), record.attitude)
    return compare_with_map(posed, load_map(cases), POSITION_SD_M, LvsOptions())


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> store.CasesFile:
    """Return the cases of a sequence over its own map, without poses."""
    folder = tmp_path_factory.mktemp("flight")
    return ingest_map(write_map_folder(folder / "in", map_scene(), POSES), folder / "out")


def test_sequence_over_its_own_map_is_registered_to_a_fraction_of_a_pixel(flight: store.CasesFile) -> None:
    for number, (name, pose) in enumerate(POSES.items()):
        record = flight.stored.cases[number].images[0]
        assert record.registration_inliers is not None, name
        comparison = compare(flight, number)
        error_px = pose_error_px(comparison, CAMERA.transform(pose))
        # landmarks of 0.3 pixels (their standard deviation in `LvsOptions`) / root of a dozen of them
        assert error_px < 0.1, name
        assert np.linalg.norm(comparison.image.world_camera.c - CAMERA.transform(pose).c) < 2.0, name


def test_all_matchers_find_an_image_without_noise_on_its_own_map(flight: store.CasesFile) -> None:
    row = compare(flight, 1).row
    # the map is the mean over its pixels, the image over its own, so that features differ, but not large templates
    assert float(row["template_yield"]) > 0.98
    assert float(row["template_correlation"]) > 0.9
    assert float(row["lvs_yield"]) > 0.8
    for name in ("sift", "orb"):
        assert float(row[f"{name}_yield"]) > 0.25, name
        assert float(row[f"{name}_inlier_fraction"]) > 0.9, name
    yields = [float(row[f"{name}_yield"]) for name in MATCHERS]
    order = [MATCHERS[index] for index in np.argsort(yields)[::-1]]
    assert [row[f"{name}_rank"] for name in order] == [1.0, 2.0, 3.0, 4.0]
    for name in MATCHERS:
        assert row[f"{name}_yield"] == float(row[f"{name}_inliers"]) / float(row[f"{name}_searched"])


def test_matchers_find_little_on_the_map_of_other_ground(flight: store.CasesFile, tmp_path: Path) -> None:
    other = map_scene(seed=2).map_product
    case = flight.stored.cases[1]
    record, (image,) = case.images[0], store.load_images(flight, case)
    posed = PosedImage.from_detector(image, np.asarray(record.pose.translation), record.attitude)
    row = compare_with_map(posed, other, POSITION_SD_M, LvsOptions()).row
    assert row["lvs_inliers"] == 0
    # a homography through four of the random positions agrees with some others: 5 % by chance, doubled by the selection
    assert float(row["template_yield"]) < 0.15
    assert max(float(row["sift_yield"]), float(row["orb_yield"])) < 0.01


@pytest.mark.parametrize("height_m", [-50.0, 30.0, 150.0])
def test_image_below_or_just_above_the_ground_has_no_templates(flight: store.CasesFile, height_m: float) -> None:
    (image,) = store.load_images(flight, flight.stored.cases[0])
    product = load_map(flight)
    position = np.array([0.0, 0.0, height_m + elevation_at(product, np.zeros(2))])
    row = compare_with_map(
        PosedImage.from_detector(image, position, Rotation.identity()), product, POSITION_SD_M, LvsOptions()
    ).row
    # the footprint of 150 m is 35 map pixels wide; a template of 31 pixels with its search range needs 55
    assert row["template_searched"] == row["lvs_inliers"] == 0
    for name in ("template_yield", "template_correlation", "template_rank"):
        assert np.isnan(float(row[name])), name


def test_image_without_matches_is_an_outcome_of_its_case(tmp_path: Path) -> None:
    folder = write_map_folder(tmp_path / "in", map_scene(), {"middle": POSES["middle"]})
    noise = np.random.default_rng(3).integers(0, 4096, CAMERA.size[::-1]).astype(np.uint16)
    cv2.imwrite(str(folder / "noise.png"), noise)
    with (folder / "images.csv").open("a") as table:
        table.write("noise,noise.png\n")
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "out"))
    assert status == 0
    assert "poses on the map: 1 by registration, 0 measured; 1 images have too few matches" in output
    campaign = tomllib.loads((tmp_path / "out" / "campaign.toml").read_text())
    assert (campaign["scenario"], campaign["cases"], "lvs" in campaign["parameters"]) == ("measured-map", 2, False)
    scenario = OverMapScenario()
    file = {"file": str(tmp_path / "out" / "cases.json")}
    result = scenario.run(scenario.parameters_type.model_validate({"cases": file, "number": 1}), STREAMS)
    assert (result.outcome, result.answered) == ("TOO_FEW_MATCHES", False)
    assert result.row["registration_inliers"] == 0


def change_text(name: str, old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


def write_truncated_jpeg(folder: Path) -> None:
    data = cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 256, (256, 256)).astype(np.uint8))[1].tobytes()
    (folder / "middle.jpg").write_bytes(data[: len(data) // 2])
    change_text("images.csv", "middle.png", "middle.jpg")(folder)


POSED = "case,file,x_m,y_m,z_m,qx,qy,qz,qw\nmiddle,middle.png,{},0,{},0,0,0,1\n"
POSE_TABLE = '[poses]\naxes = "enu"\nattitude_of = "body"\n'


@pytest.mark.parametrize(
    ("change", "messages"),
    [
        (lambda folder: write_map(folder, map_scene(seed=2)), ["map.png: no image has enough features in common"]),
        (write_truncated_jpeg, ["middle.jpg", "cannot be decoded", "truncated"]),
        (lambda folder: (folder / "middle.png").write_text("text"), ["middle.png", "is not a supported image"]),
        (lambda folder: (folder / "map.png").unlink(), ["map.png: No such file"]),
        (lambda folder: cv2.imwrite(str(folder / "map.png"), np.zeros((64, 64), np.uint8)), ["64 x 64", "128 to 4096"]),
        (lambda folder: cv2.imwrite(str(folder / "map.png"), np.ones((256, 256), np.uint8)), ["all pixels of the map"]),
        (lambda folder: np.save(folder / "elevation.npy", np.full((9, 9), np.nan)), ["elevation.npy", "not finite"]),
        (
            lambda folder: np.save(
                folder / "elevation.npy",
                np.pad(np.arange(100.0).reshape(10, 10), 2) - 9999.0 * np.pad(np.zeros((10, 10)), 2, constant_values=1),
            ),
            ["elevation.npy", "the elevation -9999 m at 96 points is probably a value for missing data"],
        ),
        (
            lambda folder: (folder / "elevation.npy").write_text("1 2"),
            ["elevation.npy", "is not a valid array of elevations"],
        ),
        (change_text("ingest.toml", 'task = "map"', 'task = "matching"'), ["map: the task map, and no other"]),
        (
            change_text("ingest.toml", "bits = 12", "bits = 12\nrows_summed = 4"),
            ["4 summed rows; allowed for map: square"],
        ),
        (change_text("ingest.toml", "pixel_m = 6.0", "pixel_m = -6"), ["map.pixel_m", "greater than 0"]),
        (
            change_text("ingest.toml", "[map]", "[map]\norigin_mars_fixed_m = [701.4, 3145.7, 1075.9]"),
            ["map.origin_mars_fixed_m", "not near the surface of Mars"],
        ),
        (change_text("images.csv", "middle,", "one,middle.png\none,"), ["case 'one' has 2 images; allowed for map: 1"]),
        (
            lambda folder: (folder / "images.csv").write_text(POSED.format(5000, 900)),
            ["case 'middle': middle.png", "outside of the map; allowed: up to 1533 m east"],
        ),
        (
            lambda folder: (folder / "images.csv").write_text(POSED.format(0, -900)),
            ["case 'middle': middle.png", "below the ground; allowed: above the map, looking down"],
        ),
        (
            lambda folder: (folder / "images.csv").write_text("case,file,qx,qy,qz,qw\nmiddle,middle.png,0,0,0,1\n"),
            ["line 2: x_m, y_m, z_m are empty; map needs them with an attitude"],
        ),
    ],
)
def test_invalid_input_has_one_message_and_status_2(
    tmp_path: Path, one_image: Path, change: Callable[[Path], object], messages: list[str]
) -> None:
    folder = tmp_path / "in"
    shutil.copytree(one_image, folder)
    change(folder)
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "out"))
    assert status == 2
    assert "Traceback" not in output
    words = " ".join(output.split())
    for message in messages:
        assert message in words
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def one_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one image and its map."""
    folder = tmp_path_factory.mktemp("one") / "in"
    return write_map_folder(folder, map_scene(), {"middle": POSES["middle"]}, POSE_TABLE)


def test_published_copies_are_read_in_grey(tmp_path: Path) -> None:
    colours = np.zeros((8, 8, 3), np.uint8)
    colours[..., 0], colours[..., 2] = 30, 90
    cv2.imwrite(str(tmp_path / "colour.png"), colours)
    assert np.array_equal(read_counts(tmp_path / "colour.png", is_published=True), np.full((8, 8), 40))
    with pytest.raises(ValueError, match="has 3 bands"):
        read_counts(tmp_path / "colour.png")
    cv2.imwrite(str(tmp_path / "grey.jpg"), np.full((16, 16), 77, np.uint8))
    assert np.array_equal(read_counts(tmp_path / "grey.jpg", is_published=True), np.full((16, 16), 77))
    with pytest.raises(ValueError, match="is not a supported image"):
        read_counts(tmp_path / "grey.jpg")


def test_size_of_lossy_images_is_recorded(tmp_path: Path, one_image: Path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(one_image, folder)
    counts = read_counts(folder / "middle.png")
    cv2.imwrite(str(folder / "lossy.jpg"), (counts / 16).astype(np.uint8))
    with (folder / "images.csv").open("a") as table:
        table.write("lossy,lossy.jpg\n")
    first, second = (case.images[0] for case in ingest_map(folder, tmp_path / "out").stored.cases)
    assert first.bits_per_pixel is None
    assert second.bits_per_pixel == 8.0 * (folder / "lossy.jpg").stat().st_size / counts.size
    assert second.registration_inliers is not None


def test_measured_poses_are_kept(tmp_path: Path, one_image: Path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(one_image, folder)
    pose = POSES["middle"]
    cells = [*np.asarray(pose.translation).tolist(), *pose.rotation.as_quat().tolist()]
    change_text("ingest.toml", '"camera.cahvor"', '"camera.cahvor"\npose_in_file = true')(folder)
    (folder / "images.csv").write_text(
        "case,file,x_m,y_m,z_m,qx,qy,qz,qw\n" + f"middle,middle.png,{','.join(map(repr, cells))}\n"
    )
    cases = ingest_map(folder, tmp_path / "out")
    record = cases.stored.cases[0].images[0]
    assert record.registration_inliers is None
    assert np.allclose(record.pose.as_matrix(), pose.as_matrix(), atol=1e-12)
    assert len(compare(cases, 0).landmarks) > 50


def write_labels(folder: Path, camera: Cahvor, parameters: str) -> Path:
    """Write an image whose label contains its model in the Mars-fixed frame, and a map."""
    folder.mkdir()
    pds3_label(folder, camera, "MCMF_FRAME", None, RigidTransform.identity(), name="lcam.img", clock=100.0)
    write_map(folder, map_scene())
    (folder / "images.csv").write_text("case,file\nlcam,lcam.img\n")
    (folder / "ingest.toml").write_text(
        f'name = "lcam"\ntask = "map"\n[detector]\nbits = 16\n[map]\nfile = "map.png"\npixel_m = 6.0\n{parameters}\n'
    )
    return folder


def test_label_in_the_mars_fixed_frame_gives_the_pose(tmp_path: Path) -> None:
    origin = np.array([701403.2, 3145680.62, 1075894.36])  # near Jezero
    mars_from_world = world_from_mars_fixed(origin).inv()
    camera = Cahvor(
        np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array([40.0, 0.0, -15.5]), np.array([0.0, -40.0, -15.5]),
        np.array([0.0, 0.0, -1.0]), np.zeros(3), (32, 32),
    )  # fmt: skip
    pose = rigid(Rotation.from_euler("ZX", [30.0, 8.0], degrees=True), np.array([120.0, -60.0, 900.0]))
    model = camera.transform(mars_from_world * pose)
    # without the position of the map the pose is unknown, and an image of 32 pixels cannot be registered
    folder = write_labels(tmp_path / "unknown", model, "")
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "none"))
    assert "no image has enough features" in " ".join(output.split())
    assert status == 2
    known = write_labels(tmp_path / "known", model, f"origin_mars_fixed_m = {origin.tolist()}")
    cases = ingest_map(known, tmp_path / "out")
    record = cases.stored.cases[0].images[0]
    (image,) = store.load_images(cases, cases.stored.cases[0])
    world = image.camera.transform(record.pose)
    # labels contain seven digits of a position of 3,400 km
    assert np.allclose(world.c, camera.transform(pose).c, atol=1.0)
    assert np.allclose(world.a, camera.transform(pose).a, atol=1e-5)


#: Model of the landing camera of Mars 2020 (`tests.sim.camera.labels.LCAM`), of 1024 x 1024 pixels.
LCAM_MODEL = Cahvore(
    c=np.zeros(3),
    a=np.array([-0.171207, -0.938368, -0.300257]),
    h=np.array([402.013, -460.182, -500.756]),
    v=np.array([241.732, -699.869, 298.075]),
    size=(1024, 1024),
    o=np.array([-0.170765, -0.938306, -0.300702]),
    r=np.array([-1.165e-06, 0.120304, 0.033668]),
    e=np.array([-0.0793475, 0.182685, -0.11582]),
    linearity=0.0,
)


def test_frames_of_the_landing_camera_are_registered_over_jezero(tmp_path: Path, shared_data: Path) -> None:
    folder, source = tmp_path / "in", shared_data / "mars2020_lcam"
    folder.mkdir()
    for name in ("frame_46.jpg", "frame_73.jpg", "jezero_map_small.jpg"):
        shutil.copy(source / name, folder)
    write_cahvor(LCAM_MODEL.scale(800 / 1024), folder / "lcam.cahvor")
    (folder / "images.csv").write_text("case,file\n46,frame_46.jpg\n73,frame_73.jpg\n")
    (folder / "ingest.toml").write_text(
        'name = "lcam"\ntask = "map"\n[camera]\nfile = "lcam.cahvor"\n[detector]\nbits = 8\n'
        '[map]\nfile = "jezero_map_small.jpg"\npixel_m = 16.0\n'
    )
    cases = ingest_map(folder, tmp_path / "out")
    image, last = (case.images[0] for case in cases.stored.cases)
    # frame 47 is at 2.1 km, and frame 28 at about 4 km: 0.1 km between successive frames. The size of the map's pixels
    # was found by fitting, and the ground is uneven by some 100 m.
    assert image.position_m is not None
    assert image.position_m[2] == pytest.approx(2200.0, abs=200.0)
    # an image from tens of metres shows no feature of a map with pixels of 16 m
    assert last.registration_inliers is None
    row = compare(cases, 0).row
    # of templates of this data 91 to 98 % are valid, with correlations of 0.67 to 0.76 (of other windows)
    assert float(row["template_yield"]) > 0.85
    assert 0.55 < float(row["template_correlation"]) < 0.85
    assert float(row["sift_yield"]) > float(row["orb_yield"])


def test_rendered_map_has_the_stated_sharpness(flight: store.CasesFile, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reduced copy of a map is sharper, in its pixels, than orbital images; the default is that of localisation."""
    mapped, parameters = load_map(flight), []

    def make_map(_world: object, p: MapParameters, *_: object) -> None:
        parameters.append(p)
        raise StopIteration

    monkeypatch.setattr(counterparts, "make_map", make_map)
    monkeypatch.setattr(LocalisationWorld, "from_parameters", lambda *_, **__: None)
    (image,) = store.load_images(flight, flight.stored.cases[0])
    recorded = PosedImage.from_detector(image, np.zeros(3), Rotation.identity())
    for p in (CounterpartParameters(), CounterpartParameters(map_aperture_px=0.4, map_nyquist_mtf=0.8)):
        with pytest.raises(StopIteration):
            render_counterpart(recorded, mapped, 255, None, p, STREAMS, is_level=True)
    defaults = MapParameters()
    assert [(p.aperture_px, p.nyquist_mtf) for p in parameters] == [
        (defaults.aperture_px, defaults.nyquist_mtf),
        (0.4, 0.8),
    ]


@pytest.mark.slow
def test_recorded_images_are_compared_with_rendered_ones(tmp_path: Path, one_image: Path) -> None:
    cases, run = tmp_path / "cases", tmp_path / "run"
    assert run_command("ingest", str(one_image), "--out", str(cases))[0] == 0
    status, output = run_command("run", str(cases / "campaign.toml"), "--out", str(run), "--jobs", "1")
    assert status == 0, output
    (row,) = pd.read_parquet(run / "cases.parquet").to_dict("records")
    assert (row["outcome"], row["rendered.outcome"]) == ("MATCHED", "MATCHED")
    # same camera, height and attitude: poses found on both maps
    for name, tolerance in (("height_m", 15.0), ("off_nadir_deg", 0.5), ("ground_pixel_m", 0.1)):
        assert row[f"rendered.{name}"] == pytest.approx(row[name], abs=tolerance), name
    # the errors of the rendered map are one pixel of 6 m, 0.9 image pixels, with a correlation over 1.5 km
    assert row["rendered.pose_error_px"] < 1.5
    declared = {column.name for column in MAP_COLUMNS}
    assert {name for name in map(str, row) if name.startswith(("rendered.", *MATCHERS))} <= declared
    report = json.loads((run / "report.json").read_text())
    medians = report["sections"]["over-map"]["medians"]
    assert medians["template_yield"] == [row["template_yield"], row["rendered.template_yield"]]
    assert "Recorded and rendered images over maps" in (run / "report.html").read_text()
    status, output = run_command("replay", str(run), "0", "--out", str(tmp_path / "again"))
    assert (status, "the row equals the stored one" in output) == (0, True)
    assert (tmp_path / "again" / "landmarks.png").stat().st_size > 10_000
