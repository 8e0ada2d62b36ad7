"""Provenance of a case's images: hash of their counts, renderer and processor."""

import hashlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt16

from marsyard.scenarios.interface import Scalar
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import Backend


def hash_images(images: Iterable[UInt16[np.ndarray, "rows columns"]]) -> str:
    """Compute the SHA-256 of the counts of images."""
    return hashlib.sha256(b"".join(counts.tobytes() for counts in images)).hexdigest()


def image_columns(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """Return the provenance columns of images rendered by a backend."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }
