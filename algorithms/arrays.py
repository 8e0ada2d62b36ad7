"""Types of arrays that many functions take: vectors, lists of points and values, and images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt16

Vector2 = Float[np.ndarray, "2"]
Vector3 = Float[np.ndarray, "3"]
Points2 = Float[np.ndarray, "n 2"]
Points3 = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, "n"]
Flags = Bool[np.ndarray, "n"]
#: An image, or a map with a value in each cell.
Raster = Float[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]
#: An image as a detector delivers it.
Counts = UInt16[np.ndarray, "rows columns"]
#: A square part of an image.
Patch = Float[np.ndarray, "n n"]
