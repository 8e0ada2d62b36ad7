"""Flights from SPICE kernels: a short TOML names the kernels, whose motion is meant, and in which frame.

    kernels = ["naif0012.tls", "mission.bsp", "mission.bc", "mission.tsc", "site.tf"]   # beside this file
    target = "-999"            # whose positions: a name or number that the kernels know
    observer = "-999900"       # from where they count: a landing site, or another body
    world = "SITE_ENU"         # the axes in which they are given
    axes = "LANDER_CAMERA"     # the frame whose attitude is meant
    begin = "2030-01-01T00:00:00"
    end = "2030-01-01T00:01:30"
    step_s = 0.1               # distance of the poses that are taken from the kernels

Geometric positions, no light time. Times are TDB seconds since `begin`, which do not know leap seconds.
"""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError
from scipy.spatial.transform import Rotation

from marsyard.sim.files import check_regular
from marsyard.sim.parameters import Parameters

#: How such a file's name ends.
SUFFIX = ".spice.toml"
#: Poses of five hours at 50 Hz; nothing is sampled more finely.
MOST_POSES = 1_000_000


class SpiceFlight(Parameters):
    """What is to be read from kernels."""

    kernels: Annotated[tuple[str, ...], Field(min_length=1, description="paths, relative to the file")]
    target: Annotated[str, Field(description="whose positions: a name or number that the kernels know")]
    observer: Annotated[str, Field(description="from where positions count")]
    world: Annotated[str, Field(description="frame in whose axes positions and attitudes are given")]
    axes: Annotated[str, Field(description="frame whose attitude is meant")]
    begin: Annotated[str, Field(description="UTC, as SPICE reads it")]
    end: Annotated[str, Field(description="UTC")]
    step_s: Annotated[float, Field(gt=0.0, le=60.0, description="seconds between poses")]


def is_spice(path: str) -> bool:
    """Whether a file tells of SPICE kernels."""
    return path.endswith(SUFFIX)


def spice_poses(path: str) -> tuple[str, Float64[np.ndarray, "n 8"]]:
    """The hash of the file and its kernels; and of each pose time (s from `begin`), position (m), quaternion (xyzw).

    Raises
    ------
    ValueError
        Where the file, a kernel, or what it asks of them is wrong; the message says which.
    ImportError
        Where the package spiceypy is not installed.
    """
    check_regular(path)
    stated = _stated(path)
    folder = Path(path).parent
    kernels = [folder / name for name in stated.kernels]
    digest = hashlib.sha256(Path(path).read_bytes())
    for kernel in kernels:
        if not kernel.is_file():
            raise ValueError(f"the kernel {kernel} is not there")
        with kernel.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest(), _sampled(stated, [str(kernel) for kernel in kernels])


def _stated(path: str) -> SpiceFlight:
    try:
        return SpiceFlight.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _sampled(stated: SpiceFlight, kernels: list[str]) -> Float64[np.ndarray, "n 8"]:
    """Poses from the kernels, which are loaded for as long as that takes."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    try:
        # the pool of kernels is the process's own: what others have loaded into it stays
        with spiceypy.KernelPool(kernels):
            begin, end = (float(spiceypy.str2et(utc)) for utc in (stated.begin, stated.end))
            count = int(np.floor((end - begin) / stated.step_s + 1e-9)) + 1
            if not 1 < count <= MOST_POSES:
                raise ValueError(f"begin, end and step_s make {max(count, 0)} poses; allowed: 2 to {MOST_POSES}")
            times = stated.step_s * np.arange(count)
            positions = spiceypy.spkpos(stated.target, begin + times, stated.world, "NONE", stated.observer)[0]
            turns = np.stack([spiceypy.pxform(stated.axes, stated.world, begin + time) for time in times])
    except SpiceyError as error:
        raise ValueError(f"SPICE: {_said(error)}") from error
    quaternions = Rotation.from_matrix(turns).as_quat()
    return np.concatenate([times[:, None], 1e3 * np.asarray(positions), quaternions], axis=1)


def _said(error: Exception) -> str:
    """What SPICE says is wrong, in a line, without its banner and traceback."""
    said = " ".join(str(getattr(error, "long", "") or error).split())
    return f"{getattr(error, 'short', '')} {said}".strip()[:300]
