"""Tests of the image hash and backend columns of a row."""

import hashlib

import numpy as np

from marsyard.scenarios.condition_columns import hash_images, image_columns
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render.backend import default_backend


def test_image_hash_depends_on_values_and_order_only() -> None:
    first, second = (np.arange(start, start + 12, dtype=np.uint16).reshape(3, 4) for start in (0, 50))
    columns = image_columns(default_backend(), hash_images([first, second]))
    assert columns["image_hash"] == hashlib.sha256(first.tobytes() + second.tobytes()).hexdigest()
    assert image_columns(default_backend(), hash_images([np.asfortranarray(first), second])) == columns
    assert image_columns(default_backend(), hash_images([second, first]))["image_hash"] != columns["image_hash"]
    assert (columns["gl_backend"], columns["processor_features"]) == (default_backend(), processor_features())
    assert columns["gl_version"]
