"""Print the OpenGL backends whose libraries can be loaded on this machine, the preferred backend first.

Runs before any package is installed. `marsyard doctor` checks whether a backend also renders.
"""

import ctypes


def can_load(*names: str) -> bool:
    """Return whether at least one of these shared libraries can be loaded."""
    for name in names:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def find_backends() -> list[str]:
    """Return the PyOpenGL names of the backends that can be loaded."""
    # Importing pyrender also imports its viewer, which loads these libraries even without a window.
    if not (can_load("libGL.so.1") and can_load("libX11.so.6") and can_load("libXrender.so.1")):
        return []
    backends = []
    if can_load("libOSMesa.so.8", "libOSMesa.so.7", "libOSMesa.so.6", "libOSMesa.so"):
        backends.append("osmesa")
    # libEGL only forwards calls to the library of a vendor.
    if can_load("libEGL.so.1") and can_load("libEGL_mesa.so.0", "libEGL_nvidia.so.0"):
        backends.append("egl")
    return backends


if __name__ == "__main__":
    print(*find_backends())
