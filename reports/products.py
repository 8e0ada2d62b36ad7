"""Products of a case (arrays and texts that it stores for its figures): reading by type and shape."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

Products = Mapping[str, Any]


def numeric_product(value: object) -> Float[np.ndarray, "..."] | None:
    """Convert a product to float64; None if it is not numeric."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def to_matrix(value: object) -> Float[np.ndarray, "_ _"] | None:
    """Convert a product to a non-empty array of two dimensions; None if it is not one."""
    values = numeric_product(value)
    return values if values is not None and values.ndim == 2 and values.size else None


#: Shape of a product: lengths, names of lengths that are equal in products read together, and None for any length.
Shape = tuple[int | str | None, ...]


def array_of_shape(value: object, *shape: int | None) -> Float[np.ndarray, "..."] | None:
    """Convert a product to an array of a shape, where None is any length; None if it has another shape."""
    arrays = read_arrays({"value": value}, {"value": shape})
    return None if arrays is None else arrays[0]


def read_arrays(
    products: Products, shapes: Mapping[str, Shape], *, finite: bool = False
) -> list[Float[np.ndarray, "..."]] | None:
    """Read products by name and shape; None if a product is missing, invalid, or not finite if `finite` is set."""
    arrays, lengths = [], dict[str, int]()
    for name, shape in shapes.items():
        values = numeric_product(products.get(name))
        if values is None or values.ndim != len(shape) or (finite and not np.isfinite(values).all()):
            return None
        for required, length in zip(shape, values.shape, strict=True):
            expected = lengths.setdefault(required, length) if isinstance(required, str) else required
            if expected not in (None, length):
                return None
        arrays.append(values)
    return arrays
