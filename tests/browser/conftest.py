"""Fixtures of a headless browser: Debian's Chromium, driven by Playwright."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Request, sync_playwright


@dataclass
class PageLog:
    """Requested addresses of a page, and its error and console messages."""

    requests: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)


#: Function of a path, and optionally window width and colour scheme (`open_page`).
OpenPage = Callable[..., tuple[Page, PageLog]]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Start Chromium once for all tests."""
    path = next((executable for name in ("chromium", "chromium-browser") if (executable := shutil.which(name))), None)
    assert path is not None, "these tests need Debian's Chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        # root in a container cannot start the sandbox; the pages are trusted
        instance = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"], timeout=120_000)
        yield instance
        instance.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[OpenPage]:
    """Return a function that opens a file in a new window; it returns the page and its log."""
    contexts = []

    def open_file(path: Path, *, width: int = 1280, scheme: str = "light") -> tuple[Page, PageLog]:
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)  # type: ignore[arg-type]
        contexts.append(context)
        context.set_default_timeout(60_000)
        page, log = context.new_page(), PageLog()

        def log_request(request: Request) -> None:
            log.requests.append(request.url)

        page.on("request", log_request)
        page.on("console", lambda message: log.messages.append(message.text))
        page.on("pageerror", lambda error: log.messages.append(str(error)))
        page.goto(path.resolve().as_uri())
        return page, log

    yield open_file
    for context in contexts:
        context.close()
