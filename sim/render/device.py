"""Dr.Jit: array types of the device that computes images, and exchange of arrays with NumPy.

A function over Dr.Jit arrays is traced once and compiled to one program, which then processes all pixels. The compiled
programs are stored in the cache folder; their names are hashes of their instructions, so they are never outdated.
Results do not depend on the number of threads, because each pixel is computed independently of the others.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from marsyard.sim.render.backend import RenderingError
from marsyard.sim.terrain.surface import ALIGNMENT_BYTES

#: Environment variable with the device: the processor's vector units, or a graphics processor of NVIDIA.
DEVICE_VARIABLE = "MARSYARD_RENDER_DEVICE"
#: What each device needs.
DEVICES = {
    "llvm": "the LLVM library (sudo apt-get install libllvm15, or set DRJIT_LIBLLVM_PATH)",
    "cuda": "a graphics processor of NVIDIA with its driver",
}


def select_device() -> str:
    """Return the device of the variable ``MARSYARD_RENDER_DEVICE``, by default llvm; RenderingError if unavailable."""
    device = os.environ.get(DEVICE_VARIABLE, "llvm").lower()
    if device not in DEVICES:
        raise RenderingError(f"{DEVICE_VARIABLE} is '{device}'; allowed: {', '.join(DEVICES)}")
    if not dr.has_backend(getattr(dr.JitBackend, device.upper())):
        raise RenderingError(f"the device {device} of {DEVICE_VARIABLE} does not work; it needs {DEVICES[device]}")
    return device


DEVICE = select_device()
_types = getattr(dr, DEVICE)
Bool, UInt8, Int32, UInt32 = _types.Bool, _types.UInt8, _types.Int32, _types.UInt32
Float, Float64 = _types.Float, _types.Float64
Array2f, Array3f, Array4f = _types.Array2f, _types.Array3f, _types.Array4f
Array2f64, Array3f64, Matrix3f64 = _types.Array2f64, _types.Array3f64, _types.Matrix3f64
#: A Dr.Jit array of one of these types.
Values = Any

dr.set_thread_count(int(os.environ.get("NUMBA_NUM_THREADS") or os.cpu_count() or 1))

#: Decorator of a function over arrays: it is traced for the first arguments, and for later ones only if their types
#: differ. Numbers are arguments of the compiled program, not constants in it.
compiled = dr.freeze(auto_opaque=False, warn_after=1000)


def description() -> str:
    """Return the versions of Dr.Jit and of the compiler of the device."""
    version = dr.detail.llvm_version() if DEVICE == "llvm" else dr.detail.cuda_version()
    return f"Dr.Jit {dr.__version__}, {DEVICE} {'.'.join(map(str, version))}"


def larger(a: Values, b: Values) -> Values:
    """Return the larger of two values; `dr.maximum` needs LLVM 17 for floating-point numbers."""
    return dr.select(a > b, a, b)


def smaller(a: Values, b: Values) -> Values:
    """Return the smaller of two values."""
    return dr.select(a < b, a, b)


def clip(a: Values, low: Values, high: Values) -> Values:
    """Limit values to an interval."""
    return smaller(larger(a, low), high)


def where(condition: Values, compute: Callable[[], Values], otherwise: Values) -> Values:
    """Return `compute()` where a condition holds, else `otherwise`.

    In contrast to `dr.select`, it is not computed for a group of neighbouring pixels without the condition.
    """
    return dr.if_stmt((), condition, compute, lambda: otherwise)


def to_device(kind: Any, values: NDArray[Any] | float, *, share: bool = False) -> Values:
    """Copy numbers of NumPy to a one-dimensional array; with `share`, aligned memory is shared with the processor."""
    flat = np.ascontiguousarray(values, dtype=_NUMPY_TYPES[kind]).reshape(-1)
    if DEVICE != "llvm" or flat.size == 0 or (share and flat.ctypes.data % ALIGNMENT_BYTES == 0):
        return kind(flat)
    # Dr.Jit would share memory that is not aligned, for which it compiles other programs
    copy = dr.empty(kind, flat.size)
    copy.numpy()[:] = flat
    return copy


_NUMPY_TYPES: dict[Any, Any] = {
    Bool: np.bool_,
    UInt8: np.uint8,
    Int32: np.int32,
    UInt32: np.uint32,
    Float: np.float32,
    Float64: np.float64,
}


def vectors_to_device(kind: Any, vectors: NDArray[Any]) -> Values:
    """Copy vectors, shape (n, 3), to an array of vectors."""
    return kind(*(to_device(dr.value_t(kind), vectors[:, axis]) for axis in range(vectors.shape[1])))


def to_host(values: Values) -> NDArray[Any]:
    """Return the computed numbers as an array of NumPy; vectors have the shape (n, 3)."""
    if dr.depth_v(values) == 1:
        return np.asarray(values.numpy())
    return np.asarray(dr.ravel(values).numpy()).reshape(-1, len(values))
