"""`marsyard gallery`: every site through the cameras that fit it, on one page."""

from __future__ import annotations

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

from marsyard.cli.pictures import Shot, take
from marsyard.reports.campaign import page_environment
from marsyard.sim.terrain import sites

Grey: TypeAlias = UInt8[np.ndarray, "rows columns"]

PAGE, SHEET = "index.html", "contact-sheet.png"
#: Maximum width of the pictures on the page, and the quality of their JPEG files and of those next to it.
PAGE_WIDTH_PX, PAGE_QUALITY, FULL_QUALITY = 760, 82, 92
#: The contact sheet: cells, gap, height of the labels, the bytes it may take, and the greys tried to stay below them.
COLUMNS, CELL_PX, GAP_PX, LABEL_PX, SHEET_BYTES = 4, (240, 180), 8, 22, 300_000
SHEET_GREYS = (64, 48, 40, 32, 26, 21, 16, 12, 8)
#: Display: percentiles of the brightness that become almost black and white, how much of the first, and the gamma.
BLACK_PERCENTILE, WHITE_PERCENTILE, BLACK_FRACTION, GAMMA = 0.5, 99.7, 0.6, 0.65

#: Site, camera, and differences from the camera's usual pose.
PLATES: Sequence[tuple[str, str, dict[str, Any]]] = (
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


@dataclass(frozen=True)
class SvgFigure:
    """A picture for the page: its shot, its grey levels, and its file of full size next to the page."""

    shot: Shot
    grey: Grey
    file: str

    @property
    def caption(self) -> str:
        """Camera, height and direction, sun."""
        s = self.shot
        facing = "looking straight down" if s.elevation_deg == -90.0 else f"looking to {s.azimuth_deg:g}°"
        return (
            f"{s.camera}, {s.altitude_m:g} m above the ground, {facing}; "
            f"sun {s.sun_elevation_deg:g}° high at {s.sun_azimuth_deg:g}°"
        )


def render_gallery(folder: Path, overwrite: bool) -> Path:
    """Render all plates and write the gallery; return the page's path. Raises ValueError."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {folder} is a file; a folder is needed")
    existing = [folder / name for name in (PAGE, SHEET) if (folder / name).exists()]
    if existing and not overwrite:
        raise ValueError(f"{existing[0]}: there already; --overwrite replaces what is there")
    above = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not os.access(above, os.W_OK):
        raise ValueError(f"--out {folder}: the folder {above} cannot be written to")
    plates = []
    for number, (site, camera, settings) in enumerate(PLATES, start=1):
        typer.echo(f"{number} of {len(PLATES)}: {site}, {camera}", err=True)
        plates.append(plate(number, Shot.usual(site, camera, **settings)))
    return write_gallery(plates, folder)


def plate(number: int, shot: Shot) -> SvgFigure:
    """Render one picture as its camera's detector delivers it; of a pair the left one."""
    picture = take(shot, both=False)[0]
    if picture.exposed is None or picture.counts is None:
        raise ValueError("only what a detector delivered can be displayed")
    signal = np.clip(picture.counts - picture.exposed.detector.parameters.offset_dn, 0.0, None)
    grey = map_to_grey(signal, np.isfinite(picture.frame.range_m))
    return SvgFigure(shot, grey, f"{number:02d}-{shot.site}-{shot.camera}.jpg")


def map_to_grey(signal: Float64[np.ndarray, "rows columns"], ground: Bool[np.ndarray, "rows columns"]) -> Grey:
    """Map counts above the offset to greys for the eye; `ground` marks the pixels that see the ground.

    White is the brightest ground; a brighter sky is compressed into the upper greys (Reinhard et al. 2002, eq. 4).
    """
    white = float(np.percentile(signal[ground] if ground.any() else signal, WHITE_PERCENTILE))
    black = BLACK_FRACTION * float(np.percentile(signal, BLACK_PERCENTILE))
    ratio = np.clip((signal - black) / max(white - black, 1.0), 0.0, None)
    brightest = max(float(np.percentile(ratio, WHITE_PERCENTILE)), 1.0)
    compressed = np.clip(ratio * (1.0 + ratio / brightest**2) / (1.0 + ratio), 0.0, 1.0)
    grey: Grey = np.rint(255.0 * compressed**GAMMA).astype(np.uint8)
    return grey


def write_gallery(plates: Sequence[SvgFigure], folder: Path) -> Path:
    """Write the page, the pictures next to it and the contact sheet; return the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in plates:
        s, (rows, columns) = one.shot, one.grey.shape
        full = encode_picture(".jpg", one.grey, [cv2.IMWRITE_JPEG_QUALITY, FULL_QUALITY])
        (folder / one.file).write_bytes(full)
        width = min(PAGE_WIDTH_PX, columns)
        small = cv2.resize(one.grey, (width, round(rows * width / columns)), interpolation=cv2.INTER_AREA)
        inline = encode_picture(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, PAGE_QUALITY])
        command = (
            f"marsyard render {s.site} --camera {s.camera} --scale {s.scale} --altitude {s.altitude_m:g} "
            f"--east {s.east_m:g} --north {s.north_m:g} "
            f"--azimuth {s.azimuth_deg:g} --elevation {s.elevation_deg:g} --sun-azimuth {s.sun_azimuth_deg:g} "
            f"--sun-elevation {s.sun_elevation_deg:g} --out {s.site}"
        )
        values = {"file": one.file, "columns": columns, "rows": rows, "caption": one.caption, "command": command}
        source = f"data:image/jpeg;base64,{base64.b64encode(inline).decode()}"
        groups.setdefault(s.site, []).append({"source": source, **values})
    (folder / SHEET).write_bytes(contact_sheet(plates))
    shown = [(sites()[name], plates_of_site) for name, plates_of_site in groups.items()]
    page = page_environment().get_template("gallery.html.j2").render(groups=shown, version=version("marsyard"))
    (folder / PAGE).write_text(page, encoding="utf-8")
    return folder / PAGE


def contact_sheet(plates: Sequence[SvgFigure]) -> bytes:
    """All pictures small, as a PNG file of at most `SHEET_BYTES`, with as many greys as fit."""
    wide, high = CELL_PX
    rows = -(-len(plates) // COLUMNS)
    size = (rows * (high + LABEL_PX + GAP_PX) + GAP_PX, COLUMNS * (wide + GAP_PX) + GAP_PX)
    sheet = np.full(size, 24, dtype=np.uint8)
    for number, one in enumerate(plates):
        top = GAP_PX + number // COLUMNS * (high + LABEL_PX + GAP_PX)
        left = GAP_PX + number % COLUMNS * (wide + GAP_PX)
        height, width = one.grey.shape
        shown = min(height, round(width * high / wide))
        first = (height - shown) // 3  # rather the upper part, where the horizon is
        cell = cv2.resize(one.grey[first : first + shown], CELL_PX, interpolation=cv2.INTER_AREA)
        sheet[top : top + high, left : left + wide] = cell
        label = f"{one.shot.site}  {one.shot.camera}  {one.shot.altitude_m:g} m"
        position = (left + 1, top + high + LABEL_PX - 8)
        cv2.putText(sheet, label, position, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 235, 1, cv2.LINE_AA)
    encoded = b""
    for greys in SHEET_GREYS:
        step = 255.0 / (greys - 1)
        coarse = np.rint(np.rint(sheet / step) * step).astype(np.uint8)
        encoded = encode_picture(".png", coarse, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        if len(encoded) <= SHEET_BYTES:
            break
    return encoded


def encode_picture(ending: str, grey: Grey, options: Sequence[int]) -> bytes:
    """Encode a picture in the format of an ending. Raises ValueError."""
    done, encoded = cv2.imencode(ending, grey, options)
    if not done:
        raise ValueError(f"a picture could not be encoded as {ending}")
    return encoded.tobytes()
