"""Pinhole views drawn by pyrender: depth and triangle numbers of the visible surface.

This module imports pyrender and PyOpenGL, which read the backend from the environment: call
`renderer.create_depth_renderer` instead of importing this module.
"""

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import pyrender
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt32
from OpenGL import GL, platform
from pyrender.shader_program import ShaderProgramCache

from marsyard.sim.render.backend import RenderingError

#: Rotation from OpenGL's camera axes (y up, looking along -z) to the view's axes (y down, z forward).
_VIEW_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
#: Maximum number of vertices: pyrender stores vertex numbers in single precision.
_MAX_VERTICES = 1 << 24
#: Folder of the shaders, with the file names of pyrender.
_SHADERS = Path(__file__).parent / "shaders"
# pyrender finds compiled shaders by the current context, and PyOpenGL finds arrays by it. With OSMesa, PyOpenGL returns
# a new object for the same context at each call: every image would compile its shaders again and increase the memory.
# With this type of result it returns the address of the context.
platform.GetCurrentContext.restype = ctypes.c_void_p


class DepthRenderer:
    """Renderer of a scene's depth and triangle numbers, with one sample at the centre of each pixel.

    `side_px` is the width and height of the image. It is fixed, because resizing takes longer than drawing.
    """

    def __init__(self, side_px: int) -> None:
        self._offscreen = pyrender.OffscreenRenderer(side_px, side_px)
        self._offscreen._renderer = _VertexRenderer(side_px, side_px)
        self._camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.5 * side_px, 0.5 * side_px)
        self._scene, self._mesh_node = pyrender.Scene(), None
        self._numbers = np.empty(0, dtype=np.int64)
        self._camera_node = self._scene.add(self._camera)

    def load(
        self,
        vertices: Float64[np.ndarray, "vertices 3"],
        faces: UInt32[np.ndarray, "faces 3"],
        triangles: Float64[np.ndarray, "triangles 3 3"],
        numbers: Int64[np.ndarray, "triangles"],
    ) -> None:
        """Load the mesh of the ground and the numbered triangles of objects; they replace previous data.

        Coordinates are those of the world, metres. Raises RenderingError if there are too many vertices.
        """
        # the corners of the objects' triangles are the first vertices: triangle i has the vertices 3 i to 3 i + 2
        corners = triangles.reshape(-1, 3)
        count = len(corners)
        if count + len(vertices) > _MAX_VERTICES:
            raise RenderingError(f"{count + len(vertices)} vertices are visible; maximum {_MAX_VERTICES}")
        # pyrender has single precision; the ground is drawn first and hides triangles of objects at the same depth
        positions = np.concatenate([corners, vertices], dtype=np.float32, casting="same_kind")
        indices = np.concatenate([faces.ravel() + count, np.arange(count)], dtype=np.float32, casting="same_kind")
        if self._mesh_node is not None:
            self._scene.remove_node(self._mesh_node)
        self._mesh_node = self._scene.add(pyrender.Mesh([pyrender.Primitive(positions, indices=indices)]))
        self._numbers = numbers

    def draw(
        self, world_from_view: Float[np.ndarray, "4 4"], focal_px: float, near_m: float, far_m: float
    ) -> tuple[Float32[np.ndarray, "side side"], Int32[np.ndarray, "_ _"]]:
        """Draw the depth along a view's axis, metres, 0 where no surface is visible, and triangle numbers.

        The numbers start at 1 for the first triangle; 0 is the ground. The array is empty if only ground is loaded. Row
        0 is the top of the view.

        - world_from_view: pose; the view's axes are x right, y down, z forward, its origin the centre of projection
        - focal_px: focal length in samples of the depth image; the principal point is the image's centre
        - near_m, far_m: depths of the clipping planes
        """
        if self._mesh_node is None:
            raise RenderingError("no mesh has been loaded")
        near, far = float(near_m), float(far_m)
        self._camera.fx = self._camera.fy = focal_px
        self._camera.znear, self._camera.zfar = near, far
        self._scene.set_pose(self._camera_node, world_from_view @ _VIEW_FROM_GL)
        flags, segments = pyrender.RenderFlags.SEG, {self._mesh_node: 0}
        if len(self._numbers) == 0:
            depths = self._offscreen.render(self._scene, flags | pyrender.RenderFlags.DEPTH_ONLY, segments)
            return depth_in_metres(depths, near, far), np.zeros((0, 0), dtype=np.int32)
        vertices, depths = self._offscreen.render(self._scene, flags, segments)
        vertices = np.ascontiguousarray(vertices[::-1])
        ids = np.zeros(vertices.shape, dtype=np.int32)
        pixels = np.flatnonzero(vertices < 3 * len(self._numbers))
        ids.ravel()[pixels] = self._numbers[vertices.ravel()[pixels] // 3] + 1
        return depth_in_metres(depths, near, far), ids

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        self._offscreen._platform.make_current()
        return " / ".join(GL.glGetString(name).decode() for name in (GL.GL_RENDERER, GL.GL_VERSION))

    def close(self) -> None:
        """Delete the context and its buffers."""
        self._offscreen.delete()


def depth_in_metres(depths: Float32[np.ndarray, "rows columns"], near: float, far: float) -> Float32[np.ndarray, "_ _"]:
    """Convert OpenGL's depths to depth along the axis, metres, 0 where there is no surface; reverse the order of rows.

    `depths` are 0 at `near`, and 1 at `far` and where there is no surface; their first row is the lowest. The result
    has single precision.
    """
    depths = depths[::-1]
    difference, total, product = np.float32(far - near), np.float32(far + near), np.float32(2.0 * near * far)
    return np.where(depths == 1.0, np.float32(0.0), product / ((1.0 - 2.0 * depths) * difference + total))


class _VertexRenderer(pyrender.Renderer):  # type: ignore[misc]
    """Renderer of pyrender with other shaders: the image of segments contains the number of a vertex of each triangle.

    Images have the values of OpenGL, without pyrender's conversions, and their first row is the lowest: depths are 0 at
    the near plane and 1 at the far plane, and the number of the background exceeds those of all vertices.
    """

    _main_fb_ms: Any
    _main_cb_ms: Any
    _main_db_ms: Any

    def __init__(self, width_px: int, height_px: int) -> None:
        super().__init__(width_px, height_px)
        self._program_cache = ShaderProgramCache(str(_SHADERS))

    def read_depth_buf(self) -> Float32[np.ndarray, "rows columns"]:
        depths = np.empty((self.viewport_height, self.viewport_width), np.float32)
        GL.glReadPixels(0, 0, self.viewport_width, self.viewport_height, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT, depths)
        return depths

    def read_color_buf(self) -> UInt32[np.ndarray, "rows columns"]:
        colours = np.empty((self.viewport_height, self.viewport_width, 4), np.uint8)
        GL.glReadPixels(0, 0, self.viewport_width, self.viewport_height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, colours)
        return colours.view("<u4")[:, :, 0]

    def _configure_main_framebuffer(self) -> None:
        # With EGL, pyrender draws into a framebuffer with four samples per pixel and copies it to one with a single
        # sample. Drawing to the latter takes a third of the time.
        super()._configure_main_framebuffer()
        if self._main_fb_ms != self._main_fb:
            GL.glDeleteFramebuffers(1, [self._main_fb_ms])
            GL.glDeleteRenderbuffers(2, [self._main_cb_ms, self._main_db_ms])
            self._main_fb_ms, self._main_cb_ms, self._main_db_ms = self._main_fb, self._main_cb, self._main_db

    def _read_main_framebuffer(self, scene: pyrender.Scene, flags: int) -> Any:
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        depths = self.read_depth_buf()
        return depths if flags & pyrender.RenderFlags.DEPTH_ONLY else (self.read_color_buf(), depths)
