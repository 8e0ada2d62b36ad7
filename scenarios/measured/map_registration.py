"""Read the map of `marsyard ingest`, and find the poses of images on it."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at, inside_map
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.algorithms.localisation.sift_pose import FeaturePose, MapFeatures, flatten, register_image
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.image_files import read_counts, read_elevation
from marsyard.scenarios.measured.layout import IngestError, MapTable
from marsyard.scenarios.user_tables import format_problems
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import DetectorImage

#: Area for each feature of a map, pixels: 20,000 features in 2048 x 2048 pixels, as for the baseline `sift`.
#: OpenCV interpolates the elevations of at most 32,767 features in one call.
_FEATURE_AREA_PX, _MAX_FEATURES = 200, 32_000
#: Smallest and largest side of a map, pixels: templates and features need some area, and time and memory are limited.
_MIN_SIDE_PX, _MAX_SIDE_PX = 128, 4096


def register_on_map(image: DetectorImage, map_product: MapProduct, features: MapFeatures) -> FeaturePose | None:
    """Find the pose of an image on a map with its features; None without enough matches."""
    posed = PosedImage.from_detector(image, np.zeros(3), Rotation.identity())
    return register_image(posed, map_product, features, LvsOptions())


def extract_features(map_product: MapProduct) -> MapFeatures:
    """Extract the features of a map, without large-scale contrast, in proportion to its area."""
    flat = replace(map_product, appearance=flatten(map_product.appearance))
    return MapFeatures.extract(flat, min(map_product.appearance.size // _FEATURE_AREA_PX, _MAX_FEATURES))


def load_map(cases: store.CasesFile) -> MapProduct:
    """Load the map of the cases. Raises ValueError if there is none, or if it has changed."""
    stored, folder = cases.stored.map, Path(cases.file).parent
    if stored is None:
        raise ValueError(f"{cases.file}: contains no map")
    appearance, elevation = (
        np.load(store.check_unchanged(folder, file), allow_pickle=False)
        for file in (stored.appearance, stored.elevation)
    )
    return create_map(appearance, elevation, stored.pixel_m)


def create_map(
    appearance: Float32[np.ndarray, "rows columns"], elevation_m: Float32[np.ndarray, "rows columns"], pixel_m: float
) -> MapProduct:
    """Create a map whose centre is the origin of the world; its maker states no errors."""
    centre = 0.5 * (np.array(appearance.shape[::-1]) - 1.0)
    return MapProduct(
        appearance,
        elevation_m,
        origin_m=-pixel_m * centre,
        pixel_m=pixel_m,
        registration_sd_m=0.0,
        distortion_sd_m=0.0,
        elevation_sd_m=0.0,
    )


def add_map(source: Path, table: MapTable, cases: store.CasesFile) -> store.StoredCases:
    """Read the map of a folder, write it next to `cases.json`, and return the cases with the map and all poses on it.

    Images without a pose are registered on the map; those with too few matches remain without a pose. Raises
    IngestError for an invalid map, for an image with a pose outside of the map, and if no image has a pose.
    """
    path, stored = source / table.file, cases.stored
    if stored.detector.rows_summed != 1:
        raise IngestError(
            f"{source}: the images have {stored.detector.rows_summed} summed rows; allowed for map: square "
            "pixels: resize the images, and scale the camera"
        )
    product = _read_map(source, table)
    features = extract_features(product)
    posed_cases, problems = [], []
    for case in stored.cases:
        try:
            (image,) = store.load_images(cases, case)
            record = _register(case.images[0], image, product, features)
        except ValueError as error:
            problems.append(f"case '{case.name}': {case.images[0].source}: {error}")
        else:
            posed_cases.append(case.model_copy(update={"images": (record,)}))
    if problems:
        raise IngestError(format_problems(path, problems))
    if all(case.images[0].world_from_body_xyzw is None for case in posed_cases):
        raise IngestError(
            f"{path}: no image has enough features in common with the map; allowed: a map of the ground in the images "
            "(map.pixel_m, north up), and images of the stated camera"
        )
    folder = Path(cases.file).parent
    files = {
        name: store.write_file(folder, "maps", f"{name}.npy", partial(np.save, arr=raster))
        for name, raster in (("appearance", product.appearance), ("elevation", product.elevation_m))
    }
    stored_map = store.StoredMap(**files, is_level=table.elevation is None, pixel_m=table.pixel_m)
    return stored.model_copy(update={"cases": tuple(posed_cases), "map": stored_map})


def describe_poses(stored: store.StoredCases) -> str:
    """Describe the origin of the images' poses in one line."""
    images = [case.images[0] for case in stored.cases]
    registered = sum(image.registration_inliers is not None for image in images)
    unknown = sum(image.world_from_body_xyzw is None for image in images)
    measured = len(images) - registered - unknown
    return f"poses on the map: {registered} by registration, {measured} measured; {unknown} images have too few matches"


def _read_map(source: Path, table: MapTable) -> MapProduct:
    """Read the files of a map. Raises IngestError."""
    path = source / table.file
    counts = read_counts(path, is_published=True)
    rows, columns = counts.shape
    if not (min(rows, columns) >= _MIN_SIDE_PX and max(rows, columns) <= _MAX_SIDE_PX):
        raise IngestError(
            f"{path}: the map has {columns} x {rows} pixels; allowed: {_MIN_SIDE_PX} to {_MAX_SIDE_PX} on each side"
        )
    if counts.min() == counts.max():
        raise IngestError(f"{path}: all pixels of the map are equal; allowed: an image of the ground")
    elevation = np.zeros((rows, columns), dtype=np.float32)
    if table.elevation is not None:
        elevation = read_elevation(source / table.elevation, (columns, rows), table.pixel_m)
    # row 0 of a file is the northernmost, row 0 of a map the southernmost
    appearance, elevation = (np.ascontiguousarray(raster[::-1], dtype=np.float32) for raster in (counts, elevation))
    return create_map(appearance, elevation, table.pixel_m)


def _register(
    record: store.StoredImage, image: DetectorImage, product: MapProduct, features: MapFeatures
) -> store.StoredImage:
    """Return the record of an image with its pose on the map. Raises ValueError for a pose outside of the map."""
    if record.world_from_body_xyzw is not None:
        _check_overlap(image.camera.transform(record.pose), product)
        return record
    solution = register_on_map(image, product, features)
    if solution is None:
        return record
    pose = {
        "position_m": tuple(solution.image.position_m.tolist()),
        "world_from_body_xyzw": tuple(solution.image.world_from_body.as_quat().tolist()),
    }
    return record.model_copy(update={**pose, "registration_inliers": solution.inliers})


def _check_overlap(camera: CameraModel, product: MapProduct) -> None:
    """Check that a camera in the world frame sees the map in the middle of its image. Raises ValueError."""
    axis = camera.boresight()
    height_m = float(camera.c[2]) - elevation_at(product, camera.c[:2])
    if not (axis[2] < 0.0 < height_m):
        raise ValueError("its pose looks up, or is below the ground; allowed: above the map, looking down")
    ground_m = camera.c[:2] - axis[:2] * height_m / axis[2]
    if not inside_map(product, ground_m):
        half_m = -product.origin_m
        raise ValueError(
            f"the middle of the image shows the ground at x = {ground_m[0]:.0f} m, y = {ground_m[1]:.0f} m, outside of "
            f"the map; allowed: up to {half_m[0]:.0f} m east or west and {half_m[1]:.0f} m north or south of its centre"
        )
