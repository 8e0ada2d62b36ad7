"""Prints the GL backends whose libraries load on this machine, the preferred one first.

Runs on a bare Python, before anything is installed. Whether a backend also renders is for `marsyard doctor` to say.
"""

import ctypes


def loads(*names: str) -> bool:
    """Whether one of these shared libraries can be loaded."""
    for name in names:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def loadable_backends() -> list[str]:
    """Names of the backends, as PyOpenGL calls them."""
    # pyrender imports its viewer with itself, and that loads these, window or not
    if not (loads("libGL.so.1") and loads("libX11.so.6") and loads("libXrender.so.1")):
        return []
    backends = []
    if loads("libOSMesa.so.8", "libOSMesa.so.7", "libOSMesa.so.6", "libOSMesa.so"):
        backends.append("osmesa")
    # libEGL only passes on to a vendor's library
    if loads("libEGL.so.1") and loads("libEGL_mesa.so.0", "libEGL_nvidia.so.0"):
        backends.append("egl")
    return backends


if __name__ == "__main__":
    print(*loadable_backends())
