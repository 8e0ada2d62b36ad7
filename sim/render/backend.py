"""The OpenGL context: the only module that knows which library draws.

OpenGL is asked for one thing: what each pixel of a pinhole view sees, as depth and number of the triangle. pyrender
draws that off-screen, through OSMesa or EGL. The platform has to be chosen before pyrender or PyOpenGL is first
imported in a process, and contexts belong to the process that made them: they survive neither fork nor threads.
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8

if TYPE_CHECKING:
    import trimesh

Backend = Literal["osmesa", "egl"]
BACKENDS: tuple[Backend, ...] = ("osmesa", "egl")
#: Environment variable that names the backend where a campaign does not.
BACKEND_VARIABLE = "MARSYARD_GL"


class RenderingError(RuntimeError):
    """OpenGL cannot draw here; the message says why and what to do."""


#: The library that each backend loads.
_LIBRARIES: dict[Backend, str] = {"osmesa": "OSMesa", "egl": "EGL"}


def default_backend() -> Backend:
    """The backend of the environment variable ``MARSYARD_GL``; without it OSMesa, or EGL where only that is installed.

    Recent Mesa no longer has OSMesa, so that new distributions lack it.
    """
    wanted = os.environ.get(BACKEND_VARIABLE, "").lower()
    if not wanted:
        installed = [backend for backend in BACKENDS if find_library(_LIBRARIES[backend])]
        return installed[0] if installed else "osmesa"
    for backend in BACKENDS:
        if wanted == backend:
            return backend
    raise RenderingError(f"{BACKEND_VARIABLE} is '{wanted}'; allowed: {', '.join(BACKENDS)}")


@dataclass(frozen=True)
class PinholeView:
    """A pinhole view to be drawn.

    Attributes
    ----------
    world_from_view
        4 x 4 pose; the view's axes are x right, y down, z forward, its origin the centre of projection.
    focal_px
        Focal length in samples of the depth picture; the principal point is the picture's centre.
    near_m, far_m
        Depths between which the ground may lie, metres.
    """

    world_from_view: Float[np.ndarray, "4 4"]
    focal_px: float
    near_m: float
    far_m: float


#: OpenGL's camera looks along -z with y up.
_VIEW_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def _colours(number: Int64[np.ndarray, "count"]) -> Float32[np.ndarray, "count 4"]:
    """Colours that spell numbers in 24 bits, least significant first."""
    spelled = np.stack([number & 255, (number >> 8) & 255, (number >> 16) & 255, np.full_like(number, 255)], axis=-1)
    return spelled.astype(np.float32) / np.float32(255.0)


def _numbers(colours: UInt8[np.ndarray, "rows columns 4"]) -> Int32[np.ndarray, "rows columns"]:
    """The numbers that colours spell; opacity spells nothing."""
    spelled = colours.view("<u4")[..., 0]
    numbers: Int32[np.ndarray, "rows columns"] = np.bitwise_and(spelled, 0xFFFFFF).view(np.int32)
    return numbers


class DepthRenderer:
    """Draws depth and triangle numbers of a scene, one sample at the centre of each pixel.

    Parameters
    ----------
    side_px
        Width and height of the depth picture. Fixed for the life of the renderer: resizing costs more than drawing.
    backend
        Which library provides the context.

    Raises
    ------
    RenderingError
        No context could be had.
    """

    def __init__(self, side_px: int, backend: Backend) -> None:
        self.side_px = side_px
        self.backend = backend
        pyrender = _import_pyrender(backend)
        try:
            self._offscreen = pyrender.OffscreenRenderer(side_px, side_px)
        except Exception as error:
            raise RenderingError(
                f"no OpenGL context through {backend} ({error}); run 'marsyard doctor' to see what is missing"
            ) from error
        _draw_single_sampled(self._offscreen._renderer)
        compile_shaders_once(self._offscreen._renderer)
        _read_quickly(self._offscreen._renderer)
        self._pyrender = pyrender
        self._scene: Any = None
        self._flags = 0

    def load(
        self,
        ground: trimesh.Trimesh,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        numbers: Int64[np.ndarray, "triangles"],
    ) -> None:
        """Makes this ground, and these triangles on it, what is drawn; what was before is released.

        Parameters
        ----------
        ground
            Mesh in world coordinates.
        triangles, numbers
            Corners in world coordinates of triangles that stand on the ground, and the number by which each is told
            apart in the picture, counted from zero.
        """
        self._clear()
        pyrender = self._pyrender
        self._flags = (
            pyrender.RenderFlags.DEPTH_ONLY
            if len(triangles) == 0
            else pyrender.RenderFlags.FLAT | pyrender.RenderFlags.RGBA
        )
        black = pyrender.MetallicRoughnessMaterial(baseColorFactor=(0.0, 0.0, 0.0, 1.0))
        primitives = [
            pyrender.Primitive(
                positions=ground.vertices.view(np.ndarray).astype(np.float32),
                indices=ground.faces.view(np.ndarray).astype(np.uint32),
                mode=pyrender.GLTF.TRIANGLES,
                material=black,
            )
        ]
        if len(triangles) > 0:
            primitives.append(
                pyrender.Primitive(
                    positions=triangles.reshape(-1, 3).astype(np.float32),
                    color_0=np.repeat(_colours(numbers + 1), 3, axis=0),
                    mode=pyrender.GLTF.TRIANGLES,
                )
            )
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        self._scene.add(pyrender.Mesh(primitives))

    def draw(self, view: PinholeView) -> tuple[Float32[np.ndarray, "side side"], Int32[np.ndarray, "side side"]]:
        """Depth along the view's axis, metres, and the number of the triangle seen plus one, 0 for the ground.

        The depth is 0 where there is nothing. The numbers are an empty array where nothing but ground is loaded. Row 0
        is the top of the view.
        """
        if self._scene is None:
            raise RenderingError("no mesh has been loaded")
        # pyrender counts pixels from the corner of the first, whose centre is at 0.5: the middle is at side / 2
        middle = self.side_px / 2.0
        camera = self._pyrender.IntrinsicsCamera(
            view.focal_px, view.focal_px, middle, middle, znear=view.near_m, zfar=view.far_m
        )
        node = self._scene.add(camera, pose=view.world_from_view @ _VIEW_FROM_GL)
        try:
            drawn = self._offscreen.render(self._scene, flags=self._flags)
        finally:
            self._scene.remove_node(node)
        if isinstance(drawn, tuple):
            colours, depth = drawn
            return depth, _numbers(colours)
        return drawn, np.zeros((0, 0), dtype=np.int32)

    def _clear(self) -> None:
        """Releases what is loaded, on the card too, now rather than when pyrender next draws."""
        if self._scene is None:
            return
        self._offscreen._platform.make_current()
        for mesh in self._scene.meshes:
            for primitive in mesh.primitives:
                primitive.delete()
        self._scene.clear()
        self._scene = None

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        from OpenGL.GL import GL_RENDERER, GL_VERSION, glGetString

        self._offscreen._platform.make_current()
        return " / ".join(glGetString(name).decode() for name in (GL_RENDERER, GL_VERSION))

    def close(self) -> None:
        """Releases the context."""
        self._offscreen.delete()


def _import_pyrender(backend: Backend) -> Any:
    if not __debug__:
        raise RenderingError("pyrender makes OpenGL calls inside assert statements: run Python without -O")
    chosen = os.environ.get("PYOPENGL_PLATFORM")
    if "OpenGL" in sys.modules and chosen != backend:
        raise RenderingError(
            f"this process already uses OpenGL through {chosen}; a process can use one backend: "
            f"start another for {backend}"
        )
    os.environ["PYOPENGL_PLATFORM"] = backend
    try:
        import pyrender
    # PyOpenGL meets a missing library with an AttributeError of the functions that it could not find
    except (ImportError, AttributeError, OSError) as error:
        raise RenderingError(
            f"OpenGL through {backend} cannot be loaded ({error}); run 'marsyard doctor' to see what is missing"
        ) from error
    return pyrender


def compile_shaders_once(renderer: Any) -> None:
    """Makes pyrender find the shaders that it has compiled.

    pyrender looks them up by the current context. PyOpenGL tells OSMesa's context by a new pointer object each time, so
    that every picture would compile its shaders anew and leave the old ones behind, some 0.3 MB. A renderer has one
    context for life.
    """
    programs = renderer._program_cache
    compile_program = programs.get_program
    compiled: dict[Any, Any] = {}

    def get_program(
        vertex_shader: str,
        fragment_shader: str,
        geometry_shader: str | None = None,
        defines: dict[str, Any] | None = None,
    ) -> Any:
        key = (vertex_shader, fragment_shader, geometry_shader, tuple(sorted((defines or {}).items())))
        if key not in compiled:
            compiled[key] = compile_program(vertex_shader, fragment_shader, geometry_shader, defines)
        return compiled[key]

    programs.get_program = get_program


def _draw_single_sampled(renderer: Any) -> None:
    """Makes pyrender draw into a buffer with one sample a pixel, at its centre.

    pyrender draws into a buffer with four samples a pixel and reads the depth of one of them, which lies off-centre
    where the driver honours multisampling (EGL): every picture would be shifted by about (0.125, 0.375) pixel.
    """
    configure = renderer._configure_main_framebuffer

    def configure_single_sampled() -> None:
        from OpenGL import GL

        existing = renderer._main_fb
        configure()
        if renderer._main_fb == existing:
            return
        size = (renderer.viewport_width, renderer.viewport_height)
        for buffer, kind in ((renderer._main_cb_ms, GL.GL_RGBA), (renderer._main_db_ms, GL.GL_DEPTH_COMPONENT24)):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, *size)

    renderer._configure_main_framebuffer = configure_single_sampled


def _read_quickly(renderer: Any) -> None:
    """Makes pyrender read pictures in few passes over memory, to the same values, with four channels of colour.

    Its own reading takes as long as drawing does.
    """

    def read(what: int, kind: int, values: Any) -> Any:
        from OpenGL import GL

        size = (renderer.viewport_width, renderer.viewport_height)
        pixels = np.frombuffer(GL.glReadPixels(0, 0, *size, what, kind), dtype=values)
        return pixels.reshape(size[1], size[0], -1)[::-1]

    def depth(near_m: float, far_m: float) -> Float32[np.ndarray, "rows columns"]:
        from OpenGL import GL

        drawn = read(GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT, np.float32)[..., 0]
        metres: Float32[np.ndarray, "rows columns"] = np.multiply(drawn, -2.0, order="C")
        metres += 1.0
        metres *= far_m - near_m
        metres += far_m + near_m
        np.divide(2.0 * near_m * far_m, metres, out=metres)
        metres[drawn == 1.0] = 0.0
        return metres

    def colours() -> UInt8[np.ndarray, "rows columns 4"]:
        from OpenGL import GL

        return np.ascontiguousarray(read(GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, np.uint8))

    def from_screen() -> None:
        from OpenGL import GL

        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, 0)
        GL.glReadBuffer(GL.GL_FRONT)

    def read_depth_buf() -> Float32[np.ndarray, "rows columns"]:
        from_screen()
        return depth(renderer._latest_znear, renderer._latest_zfar)

    def read_color_buf() -> UInt8[np.ndarray, "rows columns 4"]:
        from_screen()
        return colours()

    def read_main_framebuffer(scene: Any, flags: int) -> Any:
        from OpenGL import GL
        from pyrender import RenderFlags

        width, height = renderer._main_fb_dims
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, renderer._main_fb)
        for buffer in (GL.GL_COLOR_BUFFER_BIT, GL.GL_DEPTH_BUFFER_BIT):
            GL.glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, buffer, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb)
        camera = scene.main_camera_node.camera
        metres = depth(camera.znear, camera.zfar)
        return metres if flags & RenderFlags.DEPTH_ONLY else (colours(), metres)

    renderer.read_depth_buf = read_depth_buf
    renderer.read_color_buf = read_color_buf
    renderer._read_main_framebuffer = read_main_framebuffer
