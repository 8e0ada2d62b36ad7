"""Gallery: images of each site by suitable cameras, on one page and a contact sheet (`marsyard gallery`)."""

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import typer
from jaxtyping import Bool, Float64, UInt8

from marsyard.image_files import encode_image
from marsyard.reports.page_environment import page_environment
from marsyard.scenarios.terrain_files import SUFFIXES, is_terrain_file, load_site
from marsyard.site_images import ImageRequest, render_images

Grey: TypeAlias = UInt8[np.ndarray, "rows columns"]

PAGE, SHEET = "index.html", "contact-sheet.jpg"
#: Maximum width of the images on the page.
PAGE_WIDTH_PX = 760
#: JPEG quality of the images on the page and the contact sheet, and of the full-size files.
PAGE_QUALITY, FULL_QUALITY = 82, 92
#: Columns of the contact sheet, and width and height of its cells.
COLUMNS, CELL_PX = 4, (240, 180)
#: Gap between the cells of the contact sheet; height of the label below each, with its font scale and baseline.
GAP_PX, LABEL_PX, LABEL_SCALE, LABEL_BASELINE_PX = 8, 22, 0.42, 8
#: Grey levels of background and labels of the contact sheet.
SHEET_BACKGROUND, SHEET_TEXT = 24, 235
#: Percentiles of the signal that are displayed black and white; the black one is multiplied by `BLACK_FRACTION`.
BLACK_PERCENTILE, WHITE_PERCENTILE = 0.5, 99.7
BLACK_FRACTION = 0.6
#: Exponent of displayed grey levels.
GAMMA = 0.65

#: Images of the gallery: site, camera, and values that replace the camera's defaults.
VIEWS: Sequence[tuple[str, str, dict[str, Any]]] = (
    ("gusev", "mer-descent-flown", {"altitude_m": 1400.0, "sun_azimuth_deg": 270.0, "sun_elevation_deg": 30.0}),
    ("gusev", "mer-navcam", {"east_m": 30.0, "north_m": 40.0, "azimuth_deg": 340.0, "sun_azimuth_deg": 265.0}),
    ("gusev", "mer-hazcam", {"azimuth_deg": 20.0, "sun_azimuth_deg": 285.0, "sun_elevation_deg": 40.0}),
    ("meridiani", "mer-descent-flown", {"altitude_m": 1400.0, "sun_azimuth_deg": 270.0, "sun_elevation_deg": 25.0}),
    ("meridiani", "mer-navcam", {"azimuth_deg": 190.0, "sun_azimuth_deg": 275.0, "sun_elevation_deg": 22.0}),
    ("pisgah", "mer-descent-field", {"altitude_m": 1400.0, "sun_azimuth_deg": 120.0, "sun_elevation_deg": 30.0}),
    ("pisgah", "research-navcam", {"azimuth_deg": 200.0, "sun_azimuth_deg": 290.0, "sun_elevation_deg": 40.0}),
    ("kelso", "mer-descent-field", {"altitude_m": 2000.0, "sun_azimuth_deg": 110.0, "sun_elevation_deg": 25.0}),
    ("kelso", "research-navcam", {"azimuth_deg": 20.0, "sun_azimuth_deg": 105.0, "sun_elevation_deg": 20.0}),
    ("ivanpah", "mer-descent-field", {"altitude_m": 2000.0, "sun_azimuth_deg": 250.0, "sun_elevation_deg": 35.0}),
    ("ivanpah", "research-navcam", {"azimuth_deg": 100.0, "sun_azimuth_deg": 190.0, "sun_elevation_deg": 35.0}),
    ("mars-yard", "research-navcam", {"azimuth_deg": 40.0, "sun_azimuth_deg": 140.0, "sun_elevation_deg": 40.0}),
    ("mars-yard", "research-pancam", {"azimuth_deg": 40.0, "sun_azimuth_deg": 140.0, "sun_elevation_deg": 40.0}),
    ("heli-benign", "xc-55", {"sun_azimuth_deg": 140.0, "sun_elevation_deg": 45.0}),
    ("heli-hazardous", "xc-55", {"sun_azimuth_deg": 140.0, "sun_elevation_deg": 45.0}),
    ("heli-hazardous", "xc-55", {"altitude_m": 30.0, "sun_azimuth_deg": 140.0, "sun_elevation_deg": 30.0}),
)
#: Camera and altitude of the images of DTM files.
TERRAIN_CAMERA, TERRAIN_ALTITUDE_M = "mer-descent-flown", 500.0


@dataclass(frozen=True)
class GalleryImage:
    """One rendered image of the gallery."""

    request: ImageRequest
    grey: Grey  #: grey levels for display
    file: str  #: name of the full-size file, next to the page

    @property
    def caption(self) -> str:
        """Text with camera, height, viewing direction and sun direction."""
        request = self.request
        is_nadir = request.elevation_deg == -90.0
        direction = "looking straight down" if is_nadir else f"looking to {request.azimuth_deg:g}°"
        return (
            f"{request.camera}, {request.altitude_m:g} m above the ground, {direction}; "
            f"sun elevation {request.sun_elevation_deg:g}°, azimuth {request.sun_azimuth_deg:g}°"
        )


def render_gallery(folder: Path, overwrite: bool, terrain_files: Sequence[Path]) -> Path:
    """Render all `VIEWS` and DTM files; write the gallery and return the path of the page.

    The name of each image is printed to standard error before it is rendered. Raises ValueError if a file is no DTM
    file, or if the gallery cannot be written or already exists.
    """
    requests = [ImageRequest.from_defaults(site, camera, **values) for site, camera, values in VIEWS]
    for file in terrain_files:
        if not is_terrain_file(str(file)):
            raise ValueError(f"--terrain {file} is not a DTM file; allowed: {', '.join(SUFFIXES)}")
        requests.append(ImageRequest.from_defaults(str(file), TERRAIN_CAMERA, altitude_m=TERRAIN_ALTITUDE_M))
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {folder} is a file; a folder is needed")
    existing = [folder / name for name in (PAGE, SHEET) if (folder / name).exists()]
    if existing and not overwrite:
        raise ValueError(f"{existing[0]}: the file exists; use --overwrite to replace it")
    parent = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not os.access(parent, os.W_OK):
        raise ValueError(f"--out {folder}: the folder {parent} is not writable")
    images = []
    for number, request in enumerate(requests, start=1):
        typer.echo(f"{number} of {len(requests)}: {request.site}, {request.camera}", err=True)
        images.append(render_gallery_image(number, request))
    return write_gallery(images, folder)


def render_gallery_image(number: int, request: ImageRequest) -> GalleryImage:
    """Render an image with the detector model; for a stereo camera, the left image."""
    image = render_images(request, both=False)[0]
    if image.auto_exposure is None or image.counts is None:
        raise ValueError("an image without detector counts cannot be displayed")
    signal = np.clip(image.counts - image.auto_exposure.detector.parameters.offset_dn, 0.0, None)
    grey = map_to_grey(signal, np.isfinite(image.frame.range_m))
    return GalleryImage(request, grey, f"{number:02d}-{Path(request.site).name}-{request.camera}.jpg")


def map_to_grey(signal: Float64[np.ndarray, "rows columns"], ground: Bool[np.ndarray, "rows columns"]) -> Grey:
    """Map counts above the offset to grey levels for display; `ground` marks the pixels that show the ground.

    The brightest ground is white; a brighter sky is compressed into the upper levels (Reinhard et al. 2002, eq. 4).
    """
    white = float(np.percentile(signal[ground] if ground.any() else signal, WHITE_PERCENTILE))
    black = BLACK_FRACTION * float(np.percentile(signal, BLACK_PERCENTILE))
    ratio = np.clip((signal - black) / max(white - black, 1.0), 0.0, None)
    brightest_ratio = max(float(np.percentile(ratio, WHITE_PERCENTILE)), 1.0)
    tone_mapped = np.clip(ratio * (1.0 + ratio / brightest_ratio**2) / (1.0 + ratio), 0.0, 1.0)
    grey: Grey = np.rint(255.0 * tone_mapped**GAMMA).astype(np.uint8)
    return grey


def write_gallery(images: Sequence[GalleryImage], folder: Path) -> Path:
    """Write the page, the full-size images and the contact sheet; return the path of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    groups: dict[str, list[dict[str, Any]]] = {}
    for image in images:
        request, (rows, columns) = image.request, image.grey.shape
        full_size_jpeg = encode_image(".jpg", image.grey, [cv2.IMWRITE_JPEG_QUALITY, FULL_QUALITY])
        (folder / image.file).write_bytes(full_size_jpeg)
        width = min(PAGE_WIDTH_PX, columns)
        page_image = cv2.resize(image.grey, (width, round(rows * width / columns)), interpolation=cv2.INTER_AREA)
        page_jpeg = encode_image(".jpg", page_image, [cv2.IMWRITE_JPEG_QUALITY, PAGE_QUALITY])
        command = (
            f"marsyard render {request.site} --camera {request.camera} --scale {request.scale} "
            f"--altitude {request.altitude_m:g} --east {request.east_m:g} --north {request.north_m:g} "
            f"--azimuth {request.azimuth_deg:g} --elevation {request.elevation_deg:g} "
            f"--sun-azimuth {request.sun_azimuth_deg:g} --sun-elevation {request.sun_elevation_deg:g} "
            f"--out {Path(request.site).stem}"
        )
        values = {"file": image.file, "columns": columns, "rows": rows, "caption": image.caption, "command": command}
        source = f"data:image/jpeg;base64,{base64.b64encode(page_jpeg).decode()}"
        groups.setdefault(request.site, []).append({"source": source, **values})
    (folder / SHEET).write_bytes(draw_contact_sheet(images))
    site_images = [(load_site(name), entries) for name, entries in groups.items()]
    page = page_environment().get_template("gallery.html.j2").render(groups=site_images, version=version("marsyard"))
    (folder / PAGE).write_text(page, encoding="utf-8")
    return folder / PAGE


def draw_contact_sheet(images: Sequence[GalleryImage]) -> bytes:
    """Draw all images, reduced, on one JPEG image."""
    cell_width, cell_height = CELL_PX
    rows = -(-len(images) // COLUMNS)
    size = (rows * (cell_height + LABEL_PX + GAP_PX) + GAP_PX, COLUMNS * (cell_width + GAP_PX) + GAP_PX)
    sheet = np.full(size, SHEET_BACKGROUND, dtype=np.uint8)
    for number, image in enumerate(images):
        top = GAP_PX + number // COLUMNS * (cell_height + LABEL_PX + GAP_PX)
        left = GAP_PX + number % COLUMNS * (cell_width + GAP_PX)
        height, width = image.grey.shape
        cropped_height = min(height, round(width * cell_height / cell_width))
        first_row = (height - cropped_height) // 3  # crop more rows at the bottom: the horizon is in the upper part
        crop = image.grey[first_row : first_row + cropped_height]
        cell = cv2.resize(crop, CELL_PX, interpolation=cv2.INTER_AREA)
        sheet[top : top + cell_height, left : left + cell_width] = cell
        label = f"{Path(image.request.site).name}  {image.request.camera}  {image.request.altitude_m:g} m"
        position = (left + 1, top + cell_height + LABEL_PX - LABEL_BASELINE_PX)
        cv2.putText(sheet, label, position, cv2.FONT_HERSHEY_SIMPLEX, LABEL_SCALE, SHEET_TEXT, 1, cv2.LINE_AA)
    return encode_image(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, PAGE_QUALITY])
