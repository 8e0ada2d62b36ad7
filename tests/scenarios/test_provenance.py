"""What a row says of its pictures."""

from __future__ import annotations

import hashlib

import numpy as np

from marsyard.scenarios.conditions import rendered
from marsyard.sim.processor import processor_features
from marsyard.sim.render.backend import default_backend


def test_a_hash_is_of_the_counts_in_order_however_they_lie_in_memory() -> None:
    first, second = (np.arange(start, start + 12, dtype=np.uint16).reshape(3, 4) for start in (0, 50))
    said = rendered(default_backend(), [first, second])
    assert said["image_hash"] == hashlib.sha256(first.tobytes() + second.tobytes()).hexdigest()
    assert rendered(default_backend(), [np.asfortranarray(first), second]) == said
    assert rendered(default_backend(), [second, first])["image_hash"] != said["image_hash"]
    assert (said["gl_backend"], said["processor_features"]) == (default_backend(), processor_features())
    assert said["gl_version"]
