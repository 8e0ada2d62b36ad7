"""The device that computes images by Dr.Jit, and its array types."""

from __future__ import annotations

import os

import drjit as dr

from marsyard.sim.render.backend import RenderingError

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

# importing this module sets Dr.Jit's threads to those of numba, which workers limit to one
dr.set_thread_count(int(os.environ.get("NUMBA_NUM_THREADS") or os.cpu_count() or 1))


def description() -> str:
    """Return the versions of Dr.Jit and of the compiler of the device."""
    version = dr.detail.llvm_version() if DEVICE == "llvm" else dr.detail.cuda_version()
    return f"Dr.Jit {dr.__version__}, {DEVICE} {'.'.join(map(str, version))}"
