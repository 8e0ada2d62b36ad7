"""What a row says of its pictures: their hash, and what their last bits depend on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt16

from marsyard.scenarios.interface import Scalar
from marsyard.sim.processor import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import Backend


def rendered(backend: Backend, pictures: Iterable[UInt16[np.ndarray, "rows columns"]]) -> dict[str, Scalar]:
    """Columns of a row whose pictures this backend rendered."""
    digest = hashlib.sha256()
    for counts in pictures:
        digest.update(np.ascontiguousarray(counts).tobytes())
    return rendered_as(backend, digest.hexdigest())


def rendered_as(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """The same columns where the hash of the pictures is known."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }
