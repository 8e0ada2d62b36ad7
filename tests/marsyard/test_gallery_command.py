"""Tests of `marsyard gallery`: images, page and contact sheet."""

import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from marsyard import site_gallery as gallery_command
from marsyard.sim.sensor import PRESETS
from marsyard.sim.terrain import sites
from marsyard.site_gallery import (
    PAGE,
    SHEET,
    SHEET_BYTES,
    SHEET_GREYS,
    VIEWS,
    GalleryImage,
    compress_sheet,
    draw_contact_sheet,
    map_to_grey,
    write_gallery,
)
from marsyard.site_images import ImageRequest
from tests.command import marsyard


class _PageParser(HTMLParser):
    """Parser that collects link targets and alternative texts of images."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.alternative_texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.targets += [value for name, value in attrs if name in ("href", "src") and value]
        self.alternative_texts += [value or "" for name, value in attrs if tag == "img" and name == "alt"]


@pytest.fixture(scope="module")
def images() -> list[GalleryImage]:
    """Create images of white noise, the worst case for compression."""
    rng = np.random.default_rng(1)
    return [
        GalleryImage(
            ImageRequest.from_defaults(site, camera, **values),
            rng.integers(0, 256, (480, 640), dtype=np.uint8),
            f"{number}-{site}.jpg",
        )
        for number, (site, camera, values) in enumerate(VIEWS)
    ]


def test_every_site_and_camera_is_shown(images: list[GalleryImage]) -> None:
    """Sites with terrain for descents also have a view of a descent."""
    assert {image.request.site for image in images} == set(sites())
    assert {image.request.camera for image in images} == set(PRESETS)
    for image in images:
        site = sites()[image.request.site]
        assert site.descent is None or any(
            other.request.scale == "descent" for other in images if other.request.site == site.name
        )


def test_page_links_only_to_its_images(images: list[GalleryImage], tmp_path: Path) -> None:
    page = write_gallery(images, tmp_path / "new" / "gallery")
    parser = _PageParser()
    text = page.read_text()
    parser.feed(text)
    assert page.name == PAGE
    for link in parser.targets:
        if link.startswith("#"):
            assert f'id="{link[1:]}"' in text
        elif not link.startswith("data:image/jpeg;base64,"):
            assert (page.parent / link).is_file()
    assert len(parser.alternative_texts) == len(images)
    assert all(
        image.caption in alternative for image, alternative in zip(images, parser.alternative_texts, strict=True)
    )
    for command in re.findall(r"<code>(marsyard render [^<]*)</code>", text):
        assert "--camera" in command


def test_contact_sheet_is_small(images: list[GalleryImage]) -> None:
    brightness_ramp = np.linspace(0.0, 255.0, 640 * 480).reshape(480, 640)
    rng = np.random.default_rng(2)
    smooth_images = [
        GalleryImage(
            image.request,
            np.clip(brightness_ramp + rng.normal(0.0, 6.0, brightness_ramp.shape), 0, 255).astype(np.uint8),
            image.file,
        )
        for image in images
    ]
    sheet = draw_contact_sheet(smooth_images)
    assert len(sheet) <= SHEET_BYTES
    sheet_image = cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_UNCHANGED)
    assert sheet_image is not None
    assert len(np.unique(sheet_image)) > 8


def test_contact_sheet_of_many_images_has_the_fewest_grey_levels() -> None:
    """White noise cannot be compressed: 3 bits per pixel for 8 levels."""
    sheet = np.random.default_rng(4).integers(0, 256, (1000, 1000), dtype=np.uint8)
    png = compress_sheet(sheet)
    assert len(png) > SHEET_BYTES
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    assert len(np.unique(decoded)) == SHEET_GREYS[-1]


def test_map_to_grey_keeps_the_order_of_brightness() -> None:
    """Ground of 800 counts under a sky of 3000 counts: the sky is white, and the ground uses the other grey levels."""
    rng = np.random.default_rng(3)
    ground = np.ones((120, 160), dtype=bool)
    ground[:20] = False
    signal = np.where(ground, rng.normal(800.0, 100.0, ground.shape), 3000.0)
    grey = map_to_grey(signal, ground)
    assert (grey[~ground] > 250).all()
    assert np.ptp(np.percentile(grey[ground], [1.0, 99.0])) > 60
    order = np.argsort(signal, axis=None)
    assert (np.diff(grey.ravel()[order].astype(int)) >= 0).all()
    # without sky, the brightest terrain is white
    assert np.percentile(map_to_grey(signal[20:], ground[20:]), 99.8) > 250


@pytest.mark.parametrize("image", [np.zeros((8, 8)), np.full((8, 8), 7.0)])
def test_uniform_images_can_be_displayed(image: np.ndarray) -> None:
    assert len(np.unique(map_to_grey(image, np.zeros((8, 8), dtype=bool)))) == 1


@pytest.mark.parametrize("name", [PAGE, SHEET])
def test_existing_gallery_is_kept(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / name).write_text("existing text")
    monkeypatch.setattr(gallery_command, "VIEWS", ())
    status, _, error = marsyard("gallery", "--out", tmp_path)
    assert (status, f"{tmp_path / name}: the file exists" in error) == (2, True)
    assert (tmp_path / name).read_text() == "existing text"


@pytest.mark.slow
def test_gallery_shows_a_terrain_model(shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tile = shared_data / "gale_hirise" / "gale_1m_dem_0p5m_ortho.npz"
    monkeypatch.setattr(gallery_command, "VIEWS", ())
    page = gallery_command.render_gallery(tmp_path / "gallery", overwrite=False, terrain_files=[tile])
    text = page.read_text()
    assert f"terrain model {tile}" in text
    image = cv2.imread(str(page.parent / f"01-{tile.name}-mer-descent-flown.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image.std() > 5.0


def test_unknown_terrain_file_format_is_rejected(tmp_path: Path) -> None:
    status, _, error = marsyard("gallery", "--out", tmp_path, "--terrain", "relief.txt")
    assert (status, "--terrain relief.txt is not a DTM file; allowed: .npz, .tif, .tiff" in error) == (2, True)
