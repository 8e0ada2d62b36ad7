"""Poses sampled from SPICE kernels, which a file ``*.spice.toml`` lists with the body, the observer and the frames.

Positions are geometric, without light time; times are TDB seconds since `begin`, without leap seconds. ::

    kernels = ["naif0012.tls", "mission.bsp", "mission.bc", "mission.tsc", "site.tf"]   # relative to this file
    target = "-999"            # the body: a name or number in the kernels
    observer = "-999900"       # origin of the positions: a landing site, or another body
    world = "SITE_ENU"         # frame of positions and attitudes
    axes = "LANDER_CAMERA"     # frame whose attitude is recorded
    begin = "2030-01-01T00:00:00"
    end = "2030-01-01T00:01:30"
    step_s = 0.1               # time between poses

A kernel can be a meta-kernel, which names further kernels. SPICE reads their relative paths from the current folder;
here they are relative to the meta-kernel or, if the kernel is not there, to the file ``*.spice.toml``.
"""

import hashlib
import tomllib
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError
from scipy.spatial.transform import Rotation

from marsyard.sim.parameters import Parameters

#: Maximum number of poses sampled from SPICE kernels: five hours at 50 Hz.
MAX_SPICE_POSES = 1_000_000
#: Variables of a meta-kernel: kernels, and values of symbols in their names; and the last character of a string that
#: the next string continues.
_KERNELS, _VALUES, _SYMBOLS = "KERNELS_TO_LOAD", "PATH_VALUES", "PATH_SYMBOLS"
_CONTINUATION = "+"
#: Maximum length of a path in SPICE; and architectures of binary and transfer kernels, which are no meta-kernels.
_MAX_PATH, _NO_TEXT = 1024, ("DAF", "DAS", "XFR", "DEC")


class SpiceFlight(Parameters):
    """Content of a file ``*.spice.toml``: SPICE kernels, body, frames and times of the poses to be sampled."""

    kernels: Annotated[tuple[str, ...], Field(min_length=1, description="paths, relative to the file")]
    target: Annotated[str, Field(description="the body: a name or number in the kernels")]
    observer: Annotated[str, Field(description="origin of the positions")]
    world: Annotated[str, Field(description="frame of positions and attitudes")]
    axes: Annotated[str, Field(description="frame whose attitude is recorded")]
    begin: Annotated[str, Field(description="UTC, in a format of SPICE")]
    end: Annotated[str, Field(description="UTC")]
    step_s: Annotated[float, Field(gt=0.0, le=60.0, description="time between poses, s")]


def sample_kernels(path: str, min_poses: int) -> tuple[str, Float64[np.ndarray, "n 8"]]:
    """Sample poses from SPICE kernels; return the SHA-256 of the file and its kernels, and the poses.

    Columns: time (s since `begin`), position (m), quaternion (x, y, z, w). Raises ValueError for an invalid file or
    kernel, ImportError without the package spiceypy.
    """
    try:
        flight = SpiceFlight.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    kernels = [Path(path).parent / name for name in flight.kernels]
    missing = next((kernel for kernel in kernels if not kernel.is_file()), None)
    if missing is not None:
        raise ValueError(f"the kernel {missing} does not exist")
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    try:
        # SPICE has one kernel pool per process; kernels that other code has loaded remain in it
        with spiceypy.KernelPool([]):
            files = [file for kernel in kernels for file in _load_kernel(kernel, Path(path).parent)]
            begin, end = (float(spiceypy.str2et(utc)) for utc in (flight.begin, flight.end))
            count = int(np.floor((end - begin) / flight.step_s + 1e-9)) + 1
            if not min_poses <= count <= MAX_SPICE_POSES:
                allowed = f"{min_poses} to {MAX_SPICE_POSES}"
                raise ValueError(f"begin, end and step_s result in {max(count, 0)} poses; allowed: {allowed}")
            times = flight.step_s * np.arange(count)
            positions = spiceypy.spkpos(flight.target, begin + times, flight.world, "NONE", flight.observer)[0]
            rotations = np.stack([spiceypy.pxform(flight.axes, flight.world, begin + time) for time in times])
    except SpiceyError as error:
        # put the message on one line, without SPICE's banner and traceback
        words = [getattr(error, "short", ""), *str(getattr(error, "long", "") or error).split()]
        raise ValueError(f"SPICE: {' '.join(words).strip()[:300]}") from error
    digest = hashlib.sha256(Path(path).read_bytes())
    for kernel in files:
        with kernel.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return digest.hexdigest(), np.concatenate([times[:, None], 1e3 * np.asarray(positions), quaternions], axis=1)


def _load_kernel(kernel: Path, folder: Path) -> list[Path]:
    """Load a kernel and, if it is a meta-kernel, the kernels that it names; return all files in this order.

    Raises ValueError for a kernel that does not exist, or a meta-kernel in a meta-kernel.
    """
    import spiceypy

    if not _is_meta_kernel(kernel):
        spiceypy.furnsh(str(kernel))
        return [kernel]
    spiceypy.ldpool(str(kernel))  # assigns the variables without loading the named kernels
    names, values, symbols = (_read_strings(name) for name in (_KERNELS, _VALUES, _SYMBOLS))
    for name in (_KERNELS, _VALUES, _SYMBOLS):
        spiceypy.dvpool(name)
    if len(values) != len(symbols):
        raise ValueError(f"{kernel}: has {len(symbols)} {_SYMBOLS} and {len(values)} {_VALUES}; allowed: equal numbers")
    files = [kernel]
    for name in names:
        expanded = name
        for symbol, value in sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0])):
            expanded = expanded.replace(f"${symbol}", value)
        candidates = [kernel.parent / expanded, folder / expanded]
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            absent = " and ".join(map(str, dict.fromkeys(candidates)))
            raise ValueError(
                f"{kernel}: names the kernel {name}, but {absent} do not exist; "
                "allowed: paths relative to the meta-kernel or to this file, or absolute paths"
            )
        if _is_meta_kernel(file):
            raise ValueError(f"{kernel}: names the meta-kernel {name}; allowed: kernels that name no other kernels")
        spiceypy.furnsh(str(file))
        files.append(file)
    return files


def _is_meta_kernel(kernel: Path) -> bool:
    """Return whether a kernel is a text kernel that names other kernels."""
    import spiceypy

    return spiceypy.getfat(str(kernel))[0] not in _NO_TEXT and _KERNELS.encode() in kernel.read_bytes()


def _read_strings(name: str) -> list[str]:
    """Read the strings of a variable in the kernel pool; empty if it is not assigned."""
    import spiceypy

    strings: list[str] = []
    with spiceypy.no_found_check():
        while True:
            text, _, is_found = spiceypy.stpool(name, len(strings), _CONTINUATION, _MAX_PATH)
            if not is_found:
                return strings
            strings.append(text.strip())
