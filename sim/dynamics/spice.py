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

from marsyard.sim.parameters import Parameters

#: Maximum number of poses sampled from SPICE kernels: five hours at 50 Hz.
MAX_SPICE_POSES = 1_000_000


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
    digest = hashlib.sha256(Path(path).read_bytes())
    for kernel in kernels:
        if not kernel.is_file():
            raise ValueError(f"the kernel {kernel} does not exist")
        with kernel.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    try:
        # SPICE has one kernel pool per process; kernels that other code has loaded remain in it
        with spiceypy.KernelPool([str(kernel) for kernel in kernels]):
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
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return digest.hexdigest(), np.concatenate([times[:, None], 1e3 * np.asarray(positions), quaternions], axis=1)
