"""A case's products stage by stage, as files that other programs open: `marsyard replay --save-stages`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.errors import writing

_PIXELS = (np.uint8, np.uint16)


def write_stages(directory: Path, products: Mapping[str, Any]) -> int:
    """Write each product to its own file, numbered in the order of the stages; return the number of files.

    A picture (8 or 16 bits, two dimensions, or three with three bands) is a PNG with unchanged counts; any other array
    is `.npy`; all else is JSON. A table or list of products is a folder. Raises StoreError.
    """
    with writing(directory):
        return _write(directory, products)


def _write(directory: Path, products: Mapping[str, Any]) -> int:
    directory.mkdir(parents=True, exist_ok=True)
    written = 0
    for position, (name, value) in enumerate(products.items(), start=1):
        path = directory / f"{position:02d}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
        if isinstance(value, list) and any(isinstance(inner, np.ndarray | Mapping) for inner in value):
            value = {str(number): inner for number, inner in enumerate(value)}
        if isinstance(value, Mapping) and _holds_arrays(value):
            written += _write(path, value)
            continue
        written += 1
        if not isinstance(value, np.ndarray):
            path.with_name(f"{path.name}.json").write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
        elif (value.ndim == 2 or value.shape[2:] == (3,)) and value.dtype in _PIXELS and min(value.shape[:2]) > 1:
            import cv2

            cv2.imwrite(f"{path}.png", value)
        else:
            np.save(path.with_name(f"{path.name}.npy"), value, allow_pickle=False)
    return written


def _holds_arrays(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(_holds_arrays(inner) for inner in value.values())
    return isinstance(value, np.ndarray) or (isinstance(value, list) and any(_holds_arrays(inner) for inner in value))
