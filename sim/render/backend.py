"""Choice of the OpenGL backend (OSMesa or EGL), and creation of its renderer.

The backend must be chosen before pyrender or PyOpenGL is first imported. A context can be used only in the process and
thread that created it.
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from marsyard.sim.render.pinhole import DepthRenderer

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


def create_depth_renderer(side_px: int, backend: Backend) -> DepthRenderer:
    """Create a renderer of square depth images with `side_px` rows, and its OpenGL context.

    Raises RenderingError if no context can be created.
    """
    if not __debug__:
        raise RenderingError("pyrender calls OpenGL inside assert statements: run Python without -O")
    current = os.environ.get("PYOPENGL_PLATFORM")
    if "OpenGL" in sys.modules and current != backend:
        raise RenderingError(
            f"this process already uses OpenGL through {current}; a process can use one backend: "
            f"start another process for {backend}"
        )
    os.environ["PYOPENGL_PLATFORM"] = backend
    try:
        from marsyard.sim.render.pinhole import DepthRenderer
    # PyOpenGL raises AttributeError for the functions of a missing library
    except (ImportError, AttributeError, OSError) as error:
        raise RenderingError(
            f"OpenGL through {backend} cannot be loaded ({error}); run 'marsyard doctor' to see what is missing"
        ) from error
    try:
        return DepthRenderer(side_px)
    except Exception as error:
        raise RenderingError(
            f"no OpenGL context through {backend} ({error}); run 'marsyard doctor' to see what is missing"
        ) from error
