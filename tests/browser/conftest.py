"""A browser without a window: Debian's Chromium, driven by Playwright, which must fetch none of its own."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Request, sync_playwright


@dataclass
class Seen:
    """What a page asked for, and what it complained of."""

    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)


Open = Callable[..., tuple[Page, Seen]]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    path = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)
    assert path is not None, "these tests drive Debian's Chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        # a container's root has no sandbox to give; the pages are our own
        launched = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"], timeout=120_000)
        yield launched
        launched.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Open]:
    """Opens a file in a window of its own; returns the page and what it asks for and complains of from then on."""
    contexts = []

    def opened(path: Path, *, width: int = 1280, scheme: str = "light") -> tuple[Page, Seen]:
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)  # type: ignore[arg-type]
        contexts.append(context)
        context.set_default_timeout(60_000)
        page, seen = context.new_page(), Seen()

        def note(request: Request) -> None:
            seen.requests.append(request.url)

        page.on("request", note)
        page.on("console", lambda message: seen.complaints.append(message.text))
        page.on("pageerror", lambda error: seen.complaints.append(str(error)))
        page.goto(path.resolve().as_uri())
        return page, seen

    yield opened
    for context in contexts:
        context.close()
