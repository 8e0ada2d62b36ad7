import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.render.mesh import graded_offsets, ground_mesh


@given(finest=st.floats(0.5, 20.0), stretch=st.floats(1.01, 1000.0), count=st.integers(8, 200).map(lambda n: 2 * n + 1))
def test_offsets_reach_as_far_and_start_as_fine_as_asked(finest: float, stretch: float, count: int) -> None:
    reach = stretch * finest * (count - 1) / 2
    offsets = graded_offsets(reach, finest, count)
    gaps = np.diff(offsets)
    assert offsets[-1] == pytest.approx(reach, rel=1e-6)
    np.testing.assert_allclose(offsets, -offsets[::-1], atol=1e-9 * reach)
    assert gaps.min() == pytest.approx(finest, rel=1e-6)
    assert (np.diff(gaps[count // 2 :]) > -1e-9 * reach).all()


def test_refuses_more_lines_than_fit() -> None:
    with pytest.raises(ValueError, match="reach beyond"):
        graded_offsets(100.0, 10.0, 101)


def test_mesh_is_closed_faces_up_and_follows_the_ground(rough) -> None:
    offsets = graded_offsets(2000.0, 6.0, 65)
    mesh = ground_mesh(rough, 120.0 + offsets, -40.0 + offsets)
    assert len(mesh.faces) == 2 * 64 * 64
    assert (mesh.face_normals[:, 2] > 0.0).all()
    # no cracks: the only open edges are the square's border
    assert len(mesh.edges_unique) == 3 * 64 * 64 + 2 * 64
    middle = np.abs(mesh.vertices[:, :2] - [120.0, -40.0]).max(axis=1) < 50.0
    near = mesh.vertices[middle]
    np.testing.assert_allclose(near[:, 2], rough.height(near[:, 0], near[:, 1], level=2), atol=1e-9)
