"""Products of a case as two files: arrays in `products.npz`, other data in `products.json`."""

import io
import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from marsyard.campaigns.errors import StoreError, report_write_errors
from marsyard.campaigns.store.temporary_files import partial_suffix
from marsyard.sim.files import report_damage

#: Key of a table in `products.json` that refers to an array by its name in `products.npz`.
_ARRAY_KEY = "__array__"
#: File of the products with references in place of their arrays.
_OUTLINE_FILE = "products.json"


@dataclass(frozen=True)
class PackedProducts:
    """Products of a case as the contents of their two files.

    - outline: contents of `products.json`, in which references replace the arrays
    - arrays: contents of `products.npz`
    """

    outline: bytes
    arrays: bytes

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return len(self.outline) + len(self.arrays)


def pack_products(products: Mapping[str, Any]) -> PackedProducts:
    """Pack products into compressed bytes, which another process can write.

    Raises TypeError if a product is neither an array, a text, a number, a boolean, None, nor a table or list of these.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_move_arrays(products, "products", arrays), indent=2) + "\n"
    file = io.BytesIO()
    # images with noise hardly compress: the fastest level needs half of the time, and 1 % more space
    with ZipFile(file, "w", ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return PackedProducts(text.encode(), file.getvalue())


def save_packed(directory: Path, packed: PackedProducts, row: Mapping[str, Any]) -> None:
    """Write packed products and the row of their case into a folder; existing files are replaced.

    Raises StoreError if the folder is not writable; its files then remain unchanged.
    """
    with replace_files(directory) as folder:
        write_packed(folder, packed, row)


def write_packed(folder: Path, packed: PackedProducts, row: Mapping[str, Any]) -> None:
    """Write packed products and the row of their case into an existing folder. Raises OSError on failure."""
    (folder / "row.json").write_text(json.dumps(dict(row), indent=2) + "\n", encoding="utf-8")
    (folder / "products.npz").write_bytes(packed.arrays)
    (folder / _OUTLINE_FILE).write_bytes(packed.outline)


@contextmanager
def replace_files(directory: Path) -> Iterator[Path]:
    """Yield a temporary folder; at the end its files replace those in `directory`, except after an exception.

    Raises StoreError if the folder is not writable.
    """
    with report_write_errors(directory):
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=directory, prefix=".", suffix=partial_suffix()) as name:
            folder = Path(name)
            yield folder
            # the outline is moved last, since its presence marks a folder as complete
            for path in sorted(folder.rglob("*"), key=lambda path: (path == folder / _OUTLINE_FILE, path)):
                target = directory / path.relative_to(folder)
                if path.is_dir():
                    target.mkdir(exist_ok=True)
                else:
                    path.replace(target)


def unpack_products(packed: PackedProducts) -> dict[str, Any]:
    """Unpack products; tuples become lists."""
    with np.load(io.BytesIO(packed.arrays), allow_pickle=False) as arrays:

        def insert_array(table: dict[str, Any]) -> Any:
            return arrays[table[_ARRAY_KEY]] if set(table) == {_ARRAY_KEY} else table

        products: dict[str, Any] = json.loads(packed.outline, object_hook=insert_array)
    return products


def _move_arrays(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Move the arrays of a product to `arrays`; return the product with references instead of arrays."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{path} is an array of objects; only numbers and texts are stored")
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", path)
        while name in arrays:
            name += "_"
        arrays[name] = value
        return {_ARRAY_KEY: name}
    if isinstance(value, Mapping):
        if _ARRAY_KEY in value:
            raise TypeError(f"{path} has a key {_ARRAY_KEY}, which is reserved")
        return {str(name): _move_arrays(inner, f"{path}.{name}", arrays) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_move_arrays(inner, f"{path}.{index}", arrays) for index, inner in enumerate(value)]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"{path} is a {type(value).__name__}; allowed: arrays, texts, numbers, tables and lists of these")


def load_products(directory: Path) -> dict[str, Any]:
    """Load the products in a folder; tuples become lists.

    Raises StoreError if there are none.
    """
    with report_damage(directory, StoreError, "contains no products of a case"):
        files = [(directory / name).read_bytes() for name in (_OUTLINE_FILE, "products.npz")]
        return unpack_products(PackedProducts(*files))
