"""OpenGL rendering of pinhole views: depth and triangle numbers.

pyrender creates an off-screen context through OSMesa or EGL. Its scene graph and renderer are not used: their overhead
exceeds the drawing time of a small image. The platform must be chosen before pyrender or PyOpenGL is first imported.
A context can be used only in the process and thread that created it.
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64

from marsyard.sim.render.kernels.views import depth_in_metres

if TYPE_CHECKING:
    import trimesh

Backend = Literal["osmesa", "egl"]
BACKENDS: tuple[Backend, ...] = ("osmesa", "egl")
#: Environment variable for the backend, used if the campaign does not define it.
BACKEND_VARIABLE = "MARSYARD_GL"


class RenderingError(RuntimeError):
    """Rendering failed; the message contains the cause."""


#: The library that each backend loads.
_LIBRARIES: dict[Backend, str] = {"osmesa": "OSMesa", "egl": "EGL"}


def default_backend() -> Backend:
    """Return the backend of the variable ``MARSYARD_GL``; by default OSMesa, or EGL if OSMesa is not installed.

    Recent versions of Mesa no longer contain OSMesa.
    """
    name = os.environ.get(BACKEND_VARIABLE, "").lower()
    if not name:
        return next((backend for backend in BACKENDS if find_library(_LIBRARIES[backend])), "osmesa")
    for backend in BACKENDS:
        if name == backend:
            return backend
    raise RenderingError(f"{BACKEND_VARIABLE} is '{name}'; allowed: {', '.join(BACKENDS)}")


#: Rotation from OpenGL's camera axes (y up, looking along -z) to the view's axes (y down, z forward).
_VIEW_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])

#: Shaders that write the triangle's number as the colour of its fragments.
_VERTEX_SHADER = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 number;
uniform mat4 view;
uniform mat4 projection;
flat out vec4 number_colour;
void main()
{
    // mat4() prevents the compiler from reordering the products, which would change the rounding
    gl_Position = mat4(projection * view) * vec4(position, 1.0);
    number_colour = number;
}
"""
_FRAGMENT_SHADER = """#version 330 core
flat in vec4 number_colour;
out vec4 colour;
void main()
{
    colour = number_colour;
}
"""
#: Locations of the vertex shader's inputs.
_POSITION, _NUMBER = 0, 1
#: Numbers are encoded in the 24 bits of a colour, least significant byte first; the other bits are opacity.
_NUMBER_BITS, _OPAQUE = 0xFFFFFF, 0xFF000000


class DepthRenderer:
    """Renderer of a scene's depth and triangle numbers, with one sample at the centre of each pixel.

    `side_px` is the width and height of the image. It is fixed, because resizing takes longer than drawing. Raises
    RenderingError if no context can be created.
    """

    def __init__(self, side_px: int, backend: Backend) -> None:
        if not __debug__:
            raise RenderingError("pyrender calls OpenGL inside assert statements: run Python without -O")
        current = os.environ.get("PYOPENGL_PLATFORM")
        if "OpenGL" in sys.modules and current != backend:
            raise RenderingError(
                f"this process already uses OpenGL through {current}; a process can use one backend: "
                f"start another process for {backend}"
            )
        os.environ["PYOPENGL_PLATFORM"] = backend
        self.side_px = side_px
        self._ground_vertex_count: int | None = None
        self._object_vertex_count = 0
        try:
            import pyrender  # noqa: F401
        # PyOpenGL raises AttributeError for the functions of a missing library
        except (ImportError, AttributeError, OSError) as error:
            raise RenderingError(
                f"OpenGL through {backend} cannot be loaded ({error}); run 'marsyard doctor' to see what is missing"
            ) from error
        try:
            if backend == "osmesa":
                from pyrender.platforms.osmesa import OSMesaPlatform

                self._platform = OSMesaPlatform(side_px, side_px)
            else:
                from pyrender.platforms import egl

                device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
                self._platform = egl.EGLPlatform(side_px, side_px, device=device)
            self._platform.init_context()
            self._platform.make_current()
            self._prepare_context()
        except Exception as error:
            raise RenderingError(
                f"no OpenGL context through {backend} ({error}); run 'marsyard doctor' to see what is missing"
            ) from error

    def _prepare_context(self) -> None:
        from OpenGL import GL

        self._gl = GL
        program: int = GL.glCreateProgram()
        for kind, source in ((GL.GL_VERTEX_SHADER, _VERTEX_SHADER), (GL.GL_FRAGMENT_SHADER, _FRAGMENT_SHADER)):
            shader = GL.glCreateShader(kind)
            GL.glShaderSource(shader, source)
            GL.glCompileShader(shader)
            if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
                raise RenderingError(f"a shader does not compile: {GL.glGetShaderInfoLog(shader)}")
            GL.glAttachShader(program, shader)
        GL.glLinkProgram(program)
        if not GL.glGetProgramiv(program, GL.GL_LINK_STATUS):
            raise RenderingError(f"the shaders do not link: {GL.glGetProgramInfoLog(program)}")
        GL.glUseProgram(program)
        self._view, self._projection = (GL.glGetUniformLocation(program, name) for name in ("view", "projection"))
        self._ground_array, self._objects_array = GL.glGenVertexArrays(2)
        self._vertices, self._faces, self._triangles, self._numbers = GL.glGenBuffers(4)
        for array, vertices in ((self._ground_array, self._vertices), (self._objects_array, self._triangles)):
            GL.glBindVertexArray(array)
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, vertices)
            GL.glVertexAttribPointer(_POSITION, 3, GL.GL_FLOAT, False, 0, None)
            GL.glEnableVertexAttribArray(_POSITION)
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._numbers)
        GL.glVertexAttribPointer(_NUMBER, 4, GL.GL_UNSIGNED_BYTE, True, 0, None)
        GL.glEnableVertexAttribArray(_NUMBER)
        # the ground's vertices have the number 0
        GL.glVertexAttrib4f(_NUMBER, 0.0, 0.0, 0.0, 1.0)
        if self._platform.supports_framebuffers():
            # the context has no default framebuffer; one sample per pixel, as drivers with multisampling (EGL) return
            # the depth at an off-centre sample
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, GL.glGenFramebuffers(1))
            formats = {GL.GL_COLOR_ATTACHMENT0: GL.GL_RGBA8, GL.GL_DEPTH_ATTACHMENT: GL.GL_DEPTH_COMPONENT24}
            for attachment, format_ in formats.items():
                buffer = GL.glGenRenderbuffers(1)
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
                GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, format_, self.side_px, self.side_px)
                GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        else:
            GL.glReadBuffer(GL.GL_FRONT)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glViewport(0, 0, self.side_px, self.side_px)
        GL.glClearColor(0.0, 0.0, 0.0, 0.0)

    def load(
        self,
        ground: trimesh.Trimesh,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        numbers: Int64[np.ndarray, "triangles"],
    ) -> None:
        """Load the ground and the numbered triangles of objects, in world coordinates; they replace previous data."""
        gl = self._gl
        self._platform.make_current()
        gl.glBindVertexArray(self._ground_array)
        vertices, faces = ground.vertices.view(np.ndarray), ground.faces.view(np.ndarray)
        uploads = [
            (gl.GL_ARRAY_BUFFER, self._vertices, vertices.astype(np.float32)),
            (gl.GL_ELEMENT_ARRAY_BUFFER, self._faces, faces.astype(np.uint32)),
        ]
        if len(triangles) or self._object_vertex_count:
            colours = np.repeat((numbers + 1).astype(np.uint32) | np.uint32(_OPAQUE), 3)
            uploads.append((gl.GL_ARRAY_BUFFER, self._triangles, triangles.astype(np.float32)))
            uploads.append((gl.GL_ARRAY_BUFFER, self._numbers, colours))
        for kind, buffer, values in uploads:
            gl.glBindBuffer(kind, buffer)
            gl.glBufferData(kind, values.nbytes, np.ascontiguousarray(values), gl.GL_STREAM_DRAW)
        self._ground_vertex_count, self._object_vertex_count = faces.size, 3 * len(triangles)

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
        if self._ground_vertex_count is None:
            raise RenderingError("no mesh has been loaded")
        gl, side, near, far = self._gl, self.side_px, near_m, far_m
        self._platform.make_current()
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        view_from_world = np.linalg.inv(world_from_view @ _VIEW_FROM_GL)
        scale = 2.0 * focal_px / side
        projection = np.diag([scale, scale, (far + near) / (near - far), 0.0])
        projection[2, 3], projection[3, 2] = 2.0 * far * near / (near - far), -1.0
        for uniform, matrix in ((self._view, view_from_world), (self._projection, projection)):
            gl.glUniformMatrix4fv(uniform, 1, True, matrix.astype(np.float32))
        gl.glBindVertexArray(self._ground_array)
        # the cleared colour is already that of the ground, which is drawn faster without colours
        gl.glColorMask(False, False, False, False)
        gl.glDrawElements(gl.GL_TRIANGLES, self._ground_vertex_count, gl.GL_UNSIGNED_INT, None)
        gl.glColorMask(True, True, True, True)
        if self._object_vertex_count:
            gl.glBindVertexArray(self._objects_array)
            gl.glDrawArrays(gl.GL_TRIANGLES, 0, self._object_vertex_count)
        # OpenGL returns the lowest row first: depths from 0 to 1, and colours with red in the least significant byte
        depths = np.empty((side, side), np.float32)
        gl.glReadPixels(0, 0, side, side, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, depths)
        depth = depth_in_metres(depths, float(near), float(far))
        if self._object_vertex_count == 0:
            return depth, np.zeros((0, 0), dtype=np.int32)
        colours = np.empty((side, side, 4), np.uint8)
        gl.glReadPixels(0, 0, side, side, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, colours)
        numbers = np.bitwise_and(colours.view(np.uint32)[::-1, :, 0], np.uint32(_NUMBER_BITS), order="C")
        return depth, numbers.view(np.int32)

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        self._platform.make_current()
        return " / ".join(self._gl.glGetString(name).decode() for name in (self._gl.GL_RENDERER, self._gl.GL_VERSION))

    def close(self) -> None:
        """Delete the context and its buffers."""
        self._platform.make_current()
        self._platform.delete_context()
