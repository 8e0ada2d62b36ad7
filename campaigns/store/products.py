"""Stored products of a campaign's cases (images, histories, intermediate results), within a limit of disk space."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marsyard.campaigns.store.packed_products import PackedProducts, save_packed

#: Folder of the stored products, with a folder for each case.
CASES_FOLDER = "cases"


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
