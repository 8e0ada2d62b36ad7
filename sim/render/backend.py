"""Choice of the OpenGL backend: OSMesa or EGL.

The backend must be chosen before pyrender or PyOpenGL is first imported. A context can be used only in the process and
thread that created it.
"""

import os
from ctypes.util import find_library
from typing import Literal

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
