"""Products of a case (images, histories, intermediate results), and their files in the folder of the campaign.

Arrays are in `products.npz`, other data in `products.json`. A campaign stores products within a limit of disk space.
`write_stages` writes one file per product, for users.
"""

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
#: Folder of the stored products, with a folder for each case.
CASES_FOLDER = "cases"
#: Files of the products with references in place of their arrays, and of the arrays.
_OUTLINE_FILE, _ARRAYS_FILE = "products.json", "products.npz"
#: Types of arrays that `write_stages` writes as images.
_PIXEL_TYPES = (np.uint8, np.uint16)


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
    (folder / _ARRAYS_FILE).write_bytes(packed.arrays)
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
        files = [(directory / name).read_bytes() for name in (_OUTLINE_FILE, _ARRAYS_FILE)]
        return unpack_products(PackedProducts(*files))


def case_directory(directory: Path, case: int) -> Path:
    """Return the folder of a case's products."""
    return directory / CASES_FOLDER / str(case)


class ProductStore:
    """Stored products of a campaign, within its limit of disk space."""

    def __init__(self, directory: Path, budget_gb: float) -> None:
        self._directory = directory
        used_bytes = sum(path.stat().st_size for path in (directory / CASES_FOLDER).rglob("*") if path.is_file())
        self._free_bytes = budget_gb * 1e9 - used_bytes
        self.full = False

    def save(self, case: int, packed: PackedProducts, row: Mapping[str, Any]) -> bool:
        """Save a case's products if the disk space suffices; after the first case that does not fit, none are saved.

        Returns whether the products were saved. Raises StoreError if they cannot be written.
        """
        self.full = self.full or packed.size > self._free_bytes
        if self.full:
            return False
        self._free_bytes -= packed.size
        save_packed(case_directory(self._directory, case), packed, row)
        return True


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
