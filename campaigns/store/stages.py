"""Products of a case as one file per stage, for users (`--save-stages`)."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.errors import report_write_errors

#: Types of arrays that are written as images.
_PIXEL_TYPES = (np.uint8, np.uint16)


def write_stages(directory: Path, products: Mapping[str, Any]) -> int:
    """Write each product to a separate file, numbered in the order of the stages; return the number of files.

    An image (8 or 16 bits, 1 or 3 channels) is written as PNG with unchanged counts, other arrays as `.npy`, and other
    values as JSON. A mapping or list with arrays is written as a folder. Raises StoreError.
    """
    with report_write_errors(directory):
        return _write_products(directory, products)


def _write_products(directory: Path, products: Mapping[str, Any]) -> int:
    directory.mkdir(parents=True, exist_ok=True)
    files = 0
    for position, (name, value) in enumerate(products.items(), start=1):
        path = directory / f"{position:02d}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
        if isinstance(value, list) and any(isinstance(item, np.ndarray | Mapping) for item in value):
            value = {str(number): item for number, item in enumerate(value)}
        if isinstance(value, Mapping) and _contains_arrays(value):
            files += _write_products(path, value)
            continue
        files += 1
        if not isinstance(value, np.ndarray):
            path.with_name(f"{path.name}.json").write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
        elif (value.ndim == 2 or value.shape[2:] == (3,)) and value.dtype in _PIXEL_TYPES and min(value.shape[:2]) > 1:
            import cv2

            cv2.imwrite(f"{path}.png", value)
        else:
            np.save(path.with_name(f"{path.name}.npy"), value, allow_pickle=False)
    return files


def _contains_arrays(value: Any) -> bool:
    """Whether a product is an array, or contains arrays at any depth."""
    if isinstance(value, Mapping):
        return any(_contains_arrays(item) for item in value.values())
    return isinstance(value, np.ndarray) or (isinstance(value, list) and any(_contains_arrays(item) for item in value))
