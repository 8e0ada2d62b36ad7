"""Tests of `marsyard gallery`: images, page and contact sheet."""

import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from marsyard import site_gallery as gallery_command
from marsyard.sim.sensor import PRESETS
from marsyard.sim.terrain import sites
from marsyard.site_gallery import (
    CELL_PX,
    COLUMNS,
    GAP_PX,
    LABEL_PX,
    PAGE,
    SHEET,
    VIEWS,
    GalleryImage,
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


def test_contact_sheet_shows_each_image_in_its_cell(images: list[GalleryImage]) -> None:
    uniform = [
        GalleryImage(image.request, np.full((480, 640), 40 + 10 * number, dtype=np.uint8), image.file)
        for number, image in enumerate(images)
    ]
    sheet = cv2.imdecode(np.frombuffer(draw_contact_sheet(uniform), np.uint8), cv2.IMREAD_UNCHANGED)
    assert sheet is not None
    width, height = CELL_PX
    rows, columns = np.divmod(np.arange(len(images)), COLUMNS)
    top, left = GAP_PX + rows * (height + LABEL_PX + GAP_PX), GAP_PX + columns * (width + GAP_PX)
    centres = sheet[top + height // 2, left + width // 2].astype(int)
    assert_allclose(centres, 40 + 10 * np.arange(len(images)), atol=2)


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
