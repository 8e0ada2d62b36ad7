"""Products of a case on disk: arrays in `products.npz`, everything else in `products.json`."""

from __future__ import annotations

import io
import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from marsyard.campaigns.errors import StoreError, writing

#: Key in `products.json` that replaces an array by its name in `products.npz`.
_ARRAY = "__array__"
_OUTLINE = "products.json"


@dataclass(frozen=True)
class PackedProducts:
    """Products of a case as the bytes of their two files."""

    outline: bytes
    arrays: bytes

    @staticmethod
    def nothing() -> PackedProducts:
        """Empty products."""
        return pack_products({})

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return len(self.outline) + len(self.arrays)


def pack_products(products: Mapping[str, Any]) -> PackedProducts:
    """Pack products into bytes, so that a worker compresses them and another process writes them.

    Raises TypeError where a product is neither an array, a text, a number, a boolean, None, nor a table or list of
    these.
    """
    arrays: dict[str, np.ndarray] = {}
    outline = _outline(products, "products", arrays)
    text = json.dumps(outline, indent=2) + "\n"
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return PackedProducts(text.encode(), file.getvalue())


def save_packed(directory: Path, packed: PackedProducts, row: Mapping[str, Any]) -> None:
    """Write packed products and their case's row into a folder, in place of existing ones.

    Raises StoreError where the folder cannot be written; its files then stay as they are.
    """
    with replaced_files(directory) as folder:
        write_packed(folder, packed, row)


def write_packed(folder: Path, packed: PackedProducts, row: Mapping[str, Any]) -> None:
    """Write packed products and their case's row into an existing folder. Raises OSError where that fails."""
    (folder / "row.json").write_text(json.dumps(dict(row), indent=2) + "\n", encoding="utf-8")
    (folder / "products.npz").write_bytes(packed.arrays)
    (folder / _OUTLINE).write_bytes(packed.outline)


@contextmanager
def replaced_files(directory: Path) -> Iterator[Path]:
    """Temporary folder whose files replace those in `directory` at the end; after an exception nothing is replaced.

    Raises StoreError where the folder cannot be written.
    """
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=directory, prefix=".partial-") as name:
            folder = Path(name)
            yield folder
            # the outline last: it marks a folder as complete
            for path in sorted(folder.rglob("*"), key=lambda path: (path == folder / _OUTLINE, path)):
                target = directory / path.relative_to(folder)
                if path.is_dir():
                    target.mkdir(exist_ok=True)
                else:
                    path.replace(target)


def unpack_products(packed: PackedProducts) -> dict[str, Any]:
    """Products that were packed; tuples become lists."""
    with np.load(io.BytesIO(packed.arrays), allow_pickle=False) as arrays:
        filled: dict[str, Any] = _filled(json.loads(packed.outline), arrays)
    return filled


def _outline(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Product with its arrays moved to `arrays`."""
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
    """Products that were saved into a folder; tuples become lists. Raises StoreError where it holds none."""
    try:
        files = [(directory / name).read_bytes() for name in (_OUTLINE, "products.npz")]
        return unpack_products(PackedProducts(*files))
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise StoreError(f"{directory} holds no products of a case: {error}") from error


def _filled(outline: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Outline with its arrays inserted."""
    if isinstance(outline, dict):
        if set(outline) == {_ARRAY}:
            return arrays[outline[_ARRAY]]
        return {name: _filled(inner, arrays) for name, inner in outline.items()}
    if isinstance(outline, list):
        return [_filled(inner, arrays) for inner in outline]
    return outline
