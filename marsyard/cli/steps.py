"""A case's products stage by stage, as files that other programs open: `marsyard replay --step`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.errors import writing


def write_steps(directory: Path, products: Mapping[str, Any]) -> int:
    """Writes every product into a file of its own, numbered in the order in which the stages made them.

    A picture (whole numbers, two dimensions, or three with three bands) is a PNG with its counts as they are; any other
    array is `.npy`; all else is JSON. A table or list of products is a folder.

    Returns number of files.
    Raises StoreError where they cannot be written.
    """
    with writing(directory):
        return _write(directory, products)


def _write(directory: Path, products: Mapping[str, Any]) -> int:
    directory.mkdir(parents=True, exist_ok=True)
    written = 0
    for place, (name, value) in enumerate(products.items(), start=1):
        path = directory / f"{place:02d}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
        if isinstance(value, list) and any(isinstance(inner, np.ndarray | Mapping) for inner in value):
            value = {str(number): inner for number, inner in enumerate(value)}
        if isinstance(value, Mapping) and _holds_arrays(value):
            written += _write(path, value)
        else:
            _write_one(path, value)
            written += 1
    return written


def _holds_arrays(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(_holds_arrays(inner) for inner in value.values())
    return isinstance(value, np.ndarray) or (isinstance(value, list) and any(_holds_arrays(inner) for inner in value))


def _write_one(path: Path, value: Any) -> None:
    if not isinstance(value, np.ndarray):
        path.with_name(f"{path.name}.json").write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
    elif _is_picture(value):
        import cv2

        cv2.imwrite(f"{path}.png", value)
    else:
        np.save(path.with_name(f"{path.name}.npy"), value, allow_pickle=False)


def _is_picture(value: np.ndarray) -> bool:
    bands = value.ndim == 2 or (value.ndim == 3 and value.shape[2] == 3)
    return bands and value.dtype in (np.uint8, np.uint16) and min(value.shape[:2]) > 1
