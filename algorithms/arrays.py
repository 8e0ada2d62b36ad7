"""Array types used by all algorithms in type annotations: vectors, lists of points, and images."""

import numpy as np
from jaxtyping import Bool, Float, UInt16

Vector2 = Float[np.ndarray, "2"]
Vector3 = Float[np.ndarray, "3"]
Points2 = Float[np.ndarray, "n 2"]
Points3 = Float[np.ndarray, "n 3"]
Vector = Float[np.ndarray, "n"]
Flags = Bool[np.ndarray, "n"]  #: one value per point, track or match
#: Image, or map with one value per cell.
Raster = Float[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]
#: Raw detector image, digital numbers (DN).
Counts = UInt16[np.ndarray, "rows columns"]
#: Square part of an image.
Patch = Float[np.ndarray, "n n"]
