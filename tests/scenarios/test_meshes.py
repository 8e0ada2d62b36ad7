"""Tests of meshes from user files: formats, size and position in scenes, and hazards in the landing truth."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.relief import Relief
from marsyard.scenarios.mesh_files import MeshFileError, read_mesh
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.views import SiteGround
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Scene, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.terrain import Surface, TerrainParameters, site, synthesise

#: Edge lengths, m.
BOX = (2.0, 1.0, 0.5)


@pytest.fixture(scope="module")
def surface() -> Surface:
    flat = TerrainParameters(samples=64, spacing_m=1.0, rms_slope_deg=0.0, craters_per_km2=0.0, albedo_contrast=0.0)
    return synthesise(flat, np.random.default_rng(1))


def write_box(folder: Path, name: str = "box.stl", extents: tuple[float, float, float] = BOX) -> str:
    trimesh.creation.box(extents).export(folder / name)
    return str(folder / name)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb", "off"])
def test_mesh_formats_give_the_same_box(tmp_path: Path, surface: Surface, suffix: str) -> None:
    file = write_box(tmp_path, f"box.{suffix}")
    parameters = MeshParameters(file=file, kind="lander", east_m=20.0, north_m=30.0, sink_m=0.1, sha256=None)
    body = parameters.place_on_ground(surface, (25.0, 25.0))
    corners = body.triangles.reshape(-1, 3)
    ground = float(surface.height(20.0, 30.0))
    assert np.allclose(corners.min(axis=0), [19.0, 29.5, ground - 0.1], atol=1e-6)
    assert np.allclose(corners.max(axis=0), [21.0, 30.5, ground + 0.4], atol=1e-6)
    assert len(body.albedo) == 1
    assert body.albedo[0] == 0.5
    # Lander faces are flat: each normal is perpendicular to its triangle and points outwards.
    face_centres = body.triangles.mean(axis=1)
    outward_components = np.sum(body.normals[:, 0] * (face_centres - corners.mean(axis=0)), axis=1)
    assert np.all(outward_components > 0.0)
    assert np.allclose(np.abs(body.normals).max(axis=2), 1.0)


def test_size_heading_and_up_axis_are_applied(tmp_path: Path, surface: Surface) -> None:
    file = write_box(tmp_path, extents=(2.0, 0.5, 1.0))  # The y axis is up in this file.
    body = MeshParameters(file=file, up="y", size_m=4.0, heading_deg=90.0, east_m=20.0, north_m=30.0)
    extent = np.ptp(body.place_on_ground(surface, (20.0, 30.0)).triangles.reshape(-1, 3), axis=0)
    assert np.allclose(extent, [2.0, 4.0, 1.0], atol=1e-6)


def test_rocks_have_smooth_normals(tmp_path: Path, surface: Surface) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    sphere.export(tmp_path / "ball.stl")  # STL has no shared vertices.
    body = MeshParameters(file=str(tmp_path / "ball.stl")).place_on_ground(surface, (0.0, 0.0))
    corners = body.triangles.reshape(-1, 3)
    radial = corners - (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    assert np.min(np.sum(radial * body.normals.reshape(-1, 3), axis=1)) > 0.999


def test_mesh_is_placed_in_the_terrain_period_nearest_to_the_scene(tmp_path: Path, surface: Surface) -> None:
    parameters = MeshParameters(file=write_box(tmp_path), east_m=2.0, north_m=60.0)
    corners = parameters.place_on_ground(surface, (65.0, 3.0)).triangles.reshape(-1, 3)
    assert np.allclose((corners.min(axis=0) + corners.max(axis=0))[:2] / 2.0, [66.0, -4.0])


def raised_m(surface: Surface, file: str) -> np.ndarray:
    """Return the heights by which a mesh raises the relief; edges of a box lie between grid points."""
    ground = SiteGround(site("heli-benign"), TerrainParameters(samples=64), surface, None)
    mesh = MeshParameters(file=file, east_m=20.02, north_m=30.02)
    low, high = np.array([15.0, 25.0]), np.array([25.0, 35.0])
    without_mesh, with_mesh = (Relief.from_ground(ground, low, high, 0.05, meshes) for meshes in ((), (mesh,)))
    return np.asarray(with_mesh.heights_m - without_mesh.heights_m)


def test_mesh_raises_the_true_heights_of_a_landing(tmp_path: Path, surface: Surface) -> None:
    height_difference = raised_m(surface, write_box(tmp_path))
    assert height_difference.max() == pytest.approx(0.5, abs=1e-6)
    assert np.count_nonzero(height_difference > 0.25) * 0.05**2 == pytest.approx(2.0, rel=0.06)


def test_changed_mesh_file_is_rejected(tmp_path: Path) -> None:
    file = write_box(tmp_path)
    parameters = LandingScenarioParameters.model_validate({"meshes": [{"file": file, "kind": "rock", "size_m": 1.0}]})
    stored_values = parameters.model_dump(mode="json", round_trip=True)
    assert LandingScenarioParameters.model_validate(stored_values) == parameters
    write_box(tmp_path, extents=(1.0, 1.0, 1.0))
    with pytest.raises(ValidationError, match="has changed since the campaign was created"):
        LandingScenarioParameters.model_validate(stored_values)


def test_invalid_mesh_files_are_rejected(tmp_path: Path) -> None:
    def expect_error(path: Path, fault: str) -> None:
        with pytest.raises(MeshFileError, match=fault) as error_info:
            read_mesh(str(path))
        assert path.name in str(error_info.value)

    expect_error(tmp_path / "absent.stl", "cannot be read")
    (tmp_path / "text.txt").write_text("hello")
    expect_error(tmp_path / "text.txt", "is not a supported mesh format; allowed: .*stl")
    (tmp_path / "broken.ply").write_text("ply\nnot at all")
    expect_error(tmp_path / "broken.ply", "cannot be read as a mesh|contains no triangle")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    expect_error(tmp_path / "empty.obj", "cannot be read as a mesh|contains no triangle")
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    flat.export(tmp_path / "flat.stl")
    expect_error(tmp_path / "flat.stl", "is flat")
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(1 << 30)
    expect_error(tmp_path / "huge.stl", "larger than 256 MiB")


def export(folder: Path, mesh: trimesh.Trimesh, name: str) -> str:
    """Write the triangles as they are: trimesh does not repair them."""
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / name)
    return str(folder / name)


def reverse(mesh: trimesh.Trimesh, selected: slice) -> trimesh.Trimesh:
    faces = np.array(mesh.faces)
    faces[selected] = faces[selected, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def volume(file: str) -> float:
    a, b, c = np.moveaxis(read_mesh(file).triangles, 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb", "off"])
@pytest.mark.parametrize("selected", [slice(None), slice(0, None, 2), slice(3, 5)], ids=["all", "half", "two"])
def test_closed_bodies_are_oriented_outwards(tmp_path: Path, surface: Surface, suffix: str, selected: slice) -> None:
    """Inverted or mixed winding: two boxes and a ball have their volumes, and a box its height of 1 m in the truth."""
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    bodies = [reverse(box, selected), reverse(box.copy().apply_translation([5.0, 0.0, 0.0]), slice(None)), ball]
    bodies[2].apply_translation([0.0, 4.0, 0.0])
    file = export(tmp_path, trimesh.util.concatenate(bodies), f"bodies.{suffix}")
    # Formats with single precision give 7 digits.
    assert volume(file) == pytest.approx(4.0 + ball.volume, rel=1e-5)
    assert len(read_mesh(file).triangles) == 24 + len(ball.faces)
    assert raised_m(surface, export(tmp_path, bodies[0], f"box.{suffix}")).max() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("inverted", [(), (0,), (1,), (0, 1, 2)])
def test_walls_of_cavities_are_oriented_into_the_cavity(tmp_path: Path, inverted: tuple[int, ...]) -> None:
    """A hollow box with a stone in its cavity: the volume is 27 - 8 + 1 = 20."""
    boxes = [trimesh.creation.box((side,) * 3) for side in (3.0, 2.0, 1.0)]
    boxes = [reverse(box, slice(None)) if n in inverted else box for n, box in enumerate(boxes)]
    assert volume(export(tmp_path, trimesh.util.concatenate(boxes), "hollow.stl")) == pytest.approx(20.0)


def test_intersecting_and_touching_bodies_are_oriented_outwards(tmp_path: Path) -> None:
    """A leg that protrudes from a body is not a cavity, and neither is a body inside the box of a concave body."""
    leg = trimesh.creation.box((0.2, 0.2, 3.0))
    lander = [reverse(trimesh.creation.box((2.0, 2.0, 1.0)), slice(0, 5)), reverse(leg, slice(None))]
    assert volume(export(tmp_path, trimesh.util.concatenate(lander), "lander.stl")) == pytest.approx(4.12)
    bracket = trimesh.creation.extrude_triangulation(  # L-shaped, area 5
        [[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], [[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]], 1.0
    )
    inside = trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation([2.0, 2.0, 0.5])
    both = trimesh.util.concatenate([reverse(bracket, slice(None)), reverse(inside, slice(None))])
    assert volume(export(tmp_path, both, "bracket.obj")) == pytest.approx(5.125)
    touching = trimesh.creation.box((2.0, 2.0, 1.0)).apply_translation([2.0, 2.0, 0.0])  # one common edge
    edge = trimesh.util.concatenate([lander[0], touching])
    assert volume(export(tmp_path, edge, "edge.ply")) == pytest.approx(8.0)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_open_surfaces_are_two_sided(tmp_path: Path, surface: Surface, suffix: str) -> None:
    """A box without its bottom, with mixed winding: the top is seen from above, and the inside from below."""
    box = reverse(trimesh.creation.box((2.0, 1.0, 1.0)), slice(0, None, 3))
    is_bottom = box.triangles_center[:, 2] < -0.49
    shell = trimesh.Trimesh(box.vertices, box.faces[~is_bottom], process=False)
    file = export(tmp_path, shell, f"shell.{suffix}")
    mesh = read_mesh(file)
    assert len(mesh.triangles) == 20
    normals = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=1e-9)
    # The smooth normals are on the side of their triangle.
    assert np.sum(normals[:, None] * mesh.normals, axis=2).min() > 0.1
    assert raised_m(surface, file).max() == pytest.approx(1.0, abs=1e-6)


def test_repeated_and_degenerate_triangles_are_removed(tmp_path: Path) -> None:
    """A box whose triangles occur on both sides, as exporters write two-sided materials, is a closed body again."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    faces = np.concatenate([box.faces[:, ::-1], box.faces, [[0, 0, 1]]])
    file = export(tmp_path, trimesh.Trimesh(box.vertices, faces, process=False), "double.ply")
    assert len(read_mesh(file).triangles) == 12
    assert volume(file) == pytest.approx(1.0)


def test_surface_without_orientation_is_two_sided(tmp_path: Path) -> None:
    """A Moebius strip of 40 triangles has no outside: each triangle occurs on both sides."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    rims = [(1.0 + s * np.cos(angle / 2.0)) * np.array([np.cos(angle), np.sin(angle), 0 * angle]) for s in (-0.3, 0.3)]
    heights = [s * np.sin(angle / 2.0) for s in (-0.3, 0.3)]
    vertices = np.concatenate([np.stack([rim[0], rim[1], z], axis=1) for rim, z in zip(rims, heights, strict=True)])
    faces = []
    for k in range(20):
        a, b, c, d = k, 20 + k, k + 1, 21 + k
        if k == 19:  # the rims change places
            c, d = 20, 0
        faces += [[a, b, d], [a, d, c]]
    file = export(tmp_path, trimesh.Trimesh(vertices, faces, process=False), "strip.ply")
    assert len(read_mesh(file).triangles) == 80


@pytest.mark.parametrize("change", ["inverted", "mixed", "open", "open and inverted"])
def test_images_do_not_depend_on_the_winding(tmp_path: Path, surface: Surface, change: str) -> None:
    """A box of 1 m, seen from 8 m above: radiance, range and bodies are those of the intact box.

    The open box has no bottom. The bottom lies on the ground, so that its image is the same.
    """
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    changed = reverse(box, {"mixed": slice(0, None, 2), "open": slice(0, 0)}.get(change, slice(None)))
    if change.startswith("open"):
        is_bottom = box.triangles_center[:, 2] < -0.49
        changed = trimesh.Trimesh(box.vertices, changed.faces[~is_bottom], process=False)
    camera = Cahv.from_field_of_view(
        horizontal_rad=0.7,
        size=(128, 128),
        centre=np.zeros(3),
        axis=np.array([0, 0, -1.0]),
        right=np.array([1.0, 0, 0]),
    )
    sun = Sun(direction(np.radians(200.0), np.radians(35.0)))
    scene = Scene(surface, (20.0, 30.0), sun, Photometry(), mesh_finest_m=0.1, mesh_half_width_m=50.0, edge_rays=1)
    pose = rigid(Rotation.from_euler("x", 10.0, degrees=True), np.array([20.0, 30.0, surface.height(20.0, 30.0) + 8.0]))
    intact, frame = (
        process_renderer(default_backend()).render(
            add_meshes(scene, [MeshParameters(file=file, kind="lander", east_m=20.0, north_m=30.5)], (20.0, 30.0)),
            PixelRays.from_camera(camera),
            pose,
        )
        for file in (export(tmp_path, box, "box.ply"), export(tmp_path, changed, "changed.ply"))
    )
    # The box covers 6 m2 of about 34 m2.
    assert np.mean(intact.body >= 0) > 0.15
    np.testing.assert_array_equal(frame.body, intact.body)
    np.testing.assert_allclose(frame.range_m, intact.range_m, rtol=1e-9)
    np.testing.assert_allclose(frame.radiance, intact.radiance, atol=1e-6)
