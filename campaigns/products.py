"""A case's products on disk: arrays in one `products.npz`, everything around them in `products.json`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from campaigns.errors import StoreError

#: Stands for an array in `products.json`, with the name that it has in `products.npz`.
_ARRAY = "__array__"


def save_products(directory: Path, products: Mapping[str, Any]) -> None:
    """Writes products into a folder.

    Raises
    ------
    TypeError
        Where a product is neither an array, a text, a number, a truth value, None, nor a table or list of those.
    """
    arrays: dict[str, np.ndarray] = {}
    outline = _outline(products, "products", arrays)
    text = json.dumps(outline, indent=2)
    directory.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(directory / "products.npz", allow_pickle=False, **arrays)
    (directory / "products.json").write_text(text + "\n", encoding="utf-8")


def _outline(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """A product with its arrays taken out into `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{path} is an array of objects; only numbers and texts are stored")
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", path)
        while name in arrays:
            name += "_"
        arrays[name] = value
        return {_ARRAY: name}
    if isinstance(value, Mapping):
        if _ARRAY in value:
            raise TypeError(f"{path} has a key {_ARRAY}, which is taken")
        return {str(name): _outline(inner, f"{path}.{name}", arrays) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_outline(inner, f"{path}.{place}", arrays) for place, inner in enumerate(value)]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"{path} is a {type(value).__name__}; allowed: arrays, texts, numbers, tables and lists of those")


def load_products(directory: Path) -> dict[str, Any]:
    """The products that were saved into a folder; tuples come back as lists.

    Raises
    ------
    StoreError
        Where the folder holds none.
    """
    try:
        outline = json.loads((directory / "products.json").read_text(encoding="utf-8"))
        with np.load(directory / "products.npz", allow_pickle=False) as arrays:
            loaded: dict[str, Any] = _filled(outline, arrays)
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{directory} holds no products of a case: {error}") from error
    return loaded


def _filled(outline: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """An outline with its arrays put back."""
    if isinstance(outline, dict):
        if set(outline) == {_ARRAY}:
            return arrays[outline[_ARRAY]]
        return {name: _filled(inner, arrays) for name, inner in outline.items()}
    if isinstance(outline, list):
        return [_filled(inner, arrays) for inner in outline]
    return outline
