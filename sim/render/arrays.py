"""Arrays of Dr.Jit: compiled functions over them, selections, and exchange with NumPy.

A function over Dr.Jit arrays is traced once and compiled to one program, which then processes all pixels. The compiled
programs are stored in the cache folder; their names are hashes of their instructions, so they are never outdated.
Results do not depend on the number of threads, because each pixel is computed independently of the others.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import update_wrapper
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from marsyard.sim.render.device import DEVICE, Bool, Float, Float64, Int32, UInt8, UInt32
from marsyard.sim.terrain.surface import ALIGNMENT_BYTES

#: A Dr.Jit array of one of the types of the device.
Values = Any
#: NumPy's types of the elements of these arrays.
_NUMPY_TYPES: dict[Any, Any] = {
    Bool: np.bool_,
    UInt8: np.uint8,
    Int32: np.int32,
    UInt32: np.uint32,
    Float: np.float32,
    Float64: np.float64,
}


def compiled(function: Callable[..., Values]) -> Any:
    """Decorate a function over arrays: it is traced for the first arguments, and for later ones if their types differ.

    Numbers are arguments of the compiled program, not constants in it. The attribute `frozen` of the result is
    Dr.Jit's function. While a function is traced, Dr.Jit aborts the process if memory of other arrays is freed, which
    the collection of reference cycles could do at any time; therefore it is suspended.
    """
    frozen = dr.freeze(function, auto_opaque=False, warn_after=1000)

    def call(*arguments: Values) -> Values:
        is_enabled = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if is_enabled:
                gc.enable()

    call.__code__ = call.__code__.replace(co_name=function.__name__)  # the name that profilers show
    call.frozen = frozen  # type: ignore[attr-defined]
    return update_wrapper(call, function)


def larger(a: Values, b: Values) -> Values:
    """Return the larger of two values. With LLVM 15, `dr.maximum` of floating-point numbers aborts the process."""
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


def vectors_to_device(kind: Any, vectors: NDArray[Any]) -> Values:
    """Copy n vectors of k components, shape (n, k), to an array of the vector type `kind`."""
    return kind(*(to_device(dr.value_t(kind), vectors[:, axis]) for axis in range(vectors.shape[1])))


def to_host(values: Values) -> NDArray[Any]:
    """Return the computed numbers as an array of NumPy; vectors of k components have the shape (n, k)."""
    if dr.depth_v(values) == 1:
        return np.asarray(values.numpy())
    return np.asarray(dr.ravel(values).numpy()).reshape(-1, len(values))
