"""The OpenGL context, and the depth and triangle numbers of pinhole views that it draws.

pyrender makes the context, off-screen, through OSMesa or EGL; its scenes and renderer are not used, as they take longer
than a small picture does. The platform has to be chosen before pyrender or PyOpenGL is first imported in a process.
Contexts belong to the process that made them: they survive neither fork nor threads.
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt32
from numpy.typing import NDArray

from marsyard.sim.render.kernels.views import depth_in_metres

if TYPE_CHECKING:
    import trimesh

Backend = Literal["osmesa", "egl"]
BACKENDS: tuple[Backend, ...] = ("osmesa", "egl")
#: Environment variable that names the backend where a campaign does not.
BACKEND_VARIABLE = "MARSYARD_GL"


class RenderingError(RuntimeError):
    """OpenGL cannot draw here; the message states the cause and a remedy."""


#: The library that each backend loads.
_LIBRARIES: dict[Backend, str] = {"osmesa": "OSMesa", "egl": "EGL"}


def default_backend() -> Backend:
    """Return the backend of the environment variable ``MARSYARD_GL``; without it OSMesa, or EGL if only it is
    installed.

    Recent Mesa no longer has OSMesa, so new distributions lack it.
    """
    name = os.environ.get(BACKEND_VARIABLE, "").lower()
    if not name:
        return next((backend for backend in BACKENDS if find_library(_LIBRARIES[backend])), "osmesa")
    for backend in BACKENDS:
        if name == backend:
            return backend
    raise RenderingError(f"{BACKEND_VARIABLE} is '{name}'; allowed: {', '.join(BACKENDS)}")


@dataclass(frozen=True)
class PinholeView:
    """A pinhole view to be drawn.

    - world_from_view: pose; the view's axes are x right, y down, z forward, its origin the centre of projection
    - focal_px: focal length in samples of the depth picture; the principal point is the picture's centre
    - near_m, far_m: depths of the clipping planes
    """

    world_from_view: Float[np.ndarray, "4 4"]
    focal_px: float
    near_m: float
    far_m: float


#: OpenGL's camera looks along -z with y up.
_VIEW_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
_Numbers = NDArray[Any]

#: Passes the triangle's number from its corners to its samples.
_CORNERS = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 number;
uniform mat4 view;
uniform mat4 projection;
flat out vec4 encoded;
void main()
{
    // mat4() keeps the compiler from projecting the viewed corner instead, which rounds otherwise
    gl_Position = mat4(projection * view) * vec4(position, 1.0);
    encoded = number;
}
"""
_SAMPLES = """#version 330 core
flat in vec4 encoded;
out vec4 colour;
void main()
{
    colour = encoded;
}
"""
_POSITION, _NUMBER = 0, 1
#: Numbers are encoded in the 24 bits of a colour, least significant first; the other bits are opacity.
_NUMBER_BITS, _OPAQUE = 0xFFFFFF, 0xFF000000


class DepthRenderer:
    """Draws depth and triangle numbers of a scene, one sample at the centre of each pixel.

    `side_px`, width and height of the picture, is fixed: resizing costs more than drawing. Raises RenderingError where
    no context can be created.
    """

    def __init__(self, side_px: int, backend: Backend) -> None:
        self.side_px = side_px
        self.backend = backend
        _import_pyrender(backend)
        try:
            self._platform = _context(side_px, backend)
            self._drawing = _Drawing(side_px, in_buffer=self._platform.supports_framebuffers())
        except Exception as error:
            raise RenderingError(
                f"no OpenGL context through {backend} ({error}); run 'marsyard doctor' to see what is missing"
            ) from error
        self._loaded = False

    def load(
        self,
        ground: trimesh.Trimesh,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        numbers: Int64[np.ndarray, "triangles"],
    ) -> None:
        """Load the ground, and numbered triangles on it, in world coordinates, in place of those before."""
        self._platform.make_current()
        encoded = (numbers + 1).astype(np.uint32) | np.uint32(_OPAQUE)
        self._drawing.load(
            ground.vertices.view(np.ndarray).astype(np.float32),
            ground.faces.view(np.ndarray).astype(np.uint32),
            triangles.astype(np.float32),
            np.repeat(encoded, 3),
        )
        self._loaded = True

    def draw(self, view: PinholeView) -> tuple[Float32[np.ndarray, "side side"], Int32[np.ndarray, "_ _"]]:
        """Draw depth along the view's axis, metres, 0 for nothing, and triangle numbers plus one, 0 for the ground.

        The numbers are an empty array where only ground is loaded. Row 0 is the top of the view.
        """
        if not self._loaded:
            raise RenderingError("no mesh has been loaded")
        self._platform.make_current()
        self._drawing.draw(np.linalg.inv(view.world_from_view @ _VIEW_FROM_GL), _projection(view, self.side_px))
        depth = depth_in_metres(self._drawing.depth(), float(view.near_m), float(view.far_m))
        if self._drawing.object_corners == 0:
            return depth, np.zeros((0, 0), dtype=np.int32)
        numbers = np.bitwise_and(self._drawing.colours()[::-1], np.uint32(_NUMBER_BITS), order="C")
        return depth, numbers.view(np.int32)

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        from OpenGL.GL import GL_RENDERER, GL_VERSION, glGetString

        self._platform.make_current()
        return " / ".join(glGetString(name).decode() for name in (GL_RENDERER, GL_VERSION))

    def close(self) -> None:
        """Release the context and its buffers."""
        self._platform.make_current()
        self._platform.delete_context()


class _Drawing:
    """Program, buffers and calls of the current context.

    `in_buffer` states that the context has no picture of its own, so a framebuffer is created. It has one sample a
    pixel, at its centre: with several, drivers that honour multisampling (EGL) return an off-centre depth.
    """

    def __init__(self, side_px: int, *, in_buffer: bool) -> None:
        from OpenGL import GL

        self.gl = GL
        self.side_px = side_px
        self.ground_corners = self.object_corners = 0
        program = _program()
        GL.glUseProgram(program)
        self.view, self.projection = (GL.glGetUniformLocation(program, name) for name in ("view", "projection"))
        self.ground_array, self.objects_array = GL.glGenVertexArrays(2)
        self.vertices, self.faces, self.triangles, self.numbers = GL.glGenBuffers(4)
        for array, vertices in ((self.ground_array, self.vertices), (self.objects_array, self.triangles)):
            GL.glBindVertexArray(array)
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, vertices)
            GL.glVertexAttribPointer(_POSITION, 3, GL.GL_FLOAT, False, 0, None)
            GL.glEnableVertexAttribArray(_POSITION)
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self.numbers)
        GL.glVertexAttribPointer(_NUMBER, 4, GL.GL_UNSIGNED_BYTE, True, 0, None)
        GL.glEnableVertexAttribArray(_NUMBER)
        # the ground's corners have no numbers of their own
        GL.glVertexAttrib4f(_NUMBER, 0.0, 0.0, 0.0, 1.0)
        if in_buffer:
            self._make_buffer()
        else:
            GL.glReadBuffer(GL.GL_FRONT)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glViewport(0, 0, side_px, side_px)
        GL.glClearColor(0.0, 0.0, 0.0, 0.0)

    def _make_buffer(self) -> None:
        gl = self.gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, gl.glGenFramebuffers(1))
        for place, kind in ((gl.GL_COLOR_ATTACHMENT0, gl.GL_RGBA8), (gl.GL_DEPTH_ATTACHMENT, gl.GL_DEPTH_COMPONENT24)):
            buffer = gl.glGenRenderbuffers(1)
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, kind, self.side_px, self.side_px)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, place, gl.GL_RENDERBUFFER, buffer)

    def load(self, vertices: _Numbers, faces: _Numbers, triangles: _Numbers, numbers: _Numbers) -> None:
        """Fill the buffers: the ground's vertices and faces, triangles on it, the number of each of their corners."""
        gl = self.gl
        gl.glBindVertexArray(self.ground_array)
        self._fill(gl.GL_ARRAY_BUFFER, self.vertices, vertices)
        self._fill(gl.GL_ELEMENT_ARRAY_BUFFER, self.faces, faces)
        if len(triangles) or self.object_corners:
            self._fill(gl.GL_ARRAY_BUFFER, self.triangles, triangles)
            self._fill(gl.GL_ARRAY_BUFFER, self.numbers, numbers)
        self.ground_corners, self.object_corners = faces.size, 3 * len(triangles)

    def _fill(self, kind: int, buffer: int, values: _Numbers) -> None:
        self.gl.glBindBuffer(kind, buffer)
        self.gl.glBufferData(kind, values.nbytes, np.ascontiguousarray(values), self.gl.GL_STREAM_DRAW)

    def draw(self, view: Float64[np.ndarray, "4 4"], projection: Float64[np.ndarray, "4 4"]) -> None:
        """Draw the loaded triangles."""
        gl = self.gl
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        for place, matrix in ((self.view, view), (self.projection, projection)):
            gl.glUniformMatrix4fv(place, 1, True, matrix.astype(np.float32))
        gl.glBindVertexArray(self.ground_array)
        gl.glDrawElements(gl.GL_TRIANGLES, self.ground_corners, gl.GL_UNSIGNED_INT, None)
        if self.object_corners:
            gl.glBindVertexArray(self.objects_array)
            gl.glDrawArrays(gl.GL_TRIANGLES, 0, self.object_corners)

    def depth(self) -> Float32[np.ndarray, "side side"]:
        """OpenGL's depths, from 0 to 1, the lowest row first."""
        return self._read(self.gl.GL_DEPTH_COMPONENT, self.gl.GL_FLOAT, np.empty((self.side_px,) * 2, np.float32))

    def colours(self) -> UInt32[np.ndarray, "side side"]:
        """Colours, red in the least significant byte, the lowest row first."""
        colours = np.empty((self.side_px, self.side_px, 4), np.uint8)
        return self._read(self.gl.GL_RGBA, self.gl.GL_UNSIGNED_BYTE, colours).view(np.uint32)[..., 0]

    def _read(self, content: int, kind: int, pixels: _Numbers) -> _Numbers:
        self.gl.glReadPixels(0, 0, self.side_px, self.side_px, content, kind, pixels)
        return pixels


def _program() -> int:
    """Compile and link the shaders."""
    from OpenGL import GL

    program: int = GL.glCreateProgram()
    for kind, source in ((GL.GL_VERTEX_SHADER, _CORNERS), (GL.GL_FRAGMENT_SHADER, _SAMPLES)):
        shader = GL.glCreateShader(kind)
        GL.glShaderSource(shader, source)
        GL.glCompileShader(shader)
        if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
            raise RenderingError(f"a shader does not compile: {GL.glGetShaderInfoLog(shader)}")
        GL.glAttachShader(program, shader)
    GL.glLinkProgram(program)
    if not GL.glGetProgramiv(program, GL.GL_LINK_STATUS):
        raise RenderingError(f"the shaders do not link: {GL.glGetProgramInfoLog(program)}")
    return program


def _projection(view: PinholeView, side_px: int) -> Float64[np.ndarray, "4 4"]:
    """OpenGL's projection matrix of a view whose principal point is the picture's centre."""
    scale = 2.0 * view.focal_px / side_px
    near, far = view.near_m, view.far_m
    matrix = np.diag([scale, scale, (far + near) / (near - far), 0.0])
    matrix[2, 3], matrix[3, 2] = 2.0 * far * near / (near - far), -1.0
    return matrix


def _context(side_px: int, backend: Backend) -> Any:
    """Create a context and make it current."""
    if backend == "osmesa":
        from pyrender.platforms.osmesa import OSMesaPlatform

        platform = OSMesaPlatform(side_px, side_px)
    else:
        from pyrender.platforms import egl

        device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
        platform = egl.EGLPlatform(side_px, side_px, device=device)
    platform.init_context()
    platform.make_current()
    return platform


def _import_pyrender(backend: Backend) -> None:
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
        import pyrender  # noqa: F401
    # PyOpenGL raises AttributeError for the functions of a missing library
    except (ImportError, AttributeError, OSError) as error:
        raise RenderingError(
            f"OpenGL through {backend} cannot be loaded ({error}); run 'marsyard doctor' to see what is missing"
        ) from error
