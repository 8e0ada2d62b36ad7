"""Reports and the dashboard in a browser: what a reader sees and does, and what leaves the page."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Page

from marsyard.reports.campaign import write_report
from marsyard.reports.dashboard.site import write_site

Open = Callable[..., tuple[Page, Any]]
#: The success criteria of WCAG 2.2 of levels A and AA, as axe-core names its rules' sets.
LEVELS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22a", "wcag22aa"]


def _made_up() -> ModuleType:
    """The synthetic runs of the reports' own tests."""
    path = Path(__file__).resolve().parents[1] / "reports" / "conftest.py"
    spec = importlib.util.spec_from_file_location("made_up_runs", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site over three campaigns, one of them with pictures of a case."""
    folder, made = tmp_path_factory.mktemp("campaigns"), _made_up()
    for day, (site, cases) in enumerate((("gusev", 300), ("meridiani", 24), ("gusev", 24)), start=1):
        frame = made.synthetic_frame(cases, terrains=1000, seed=day, crashed=day == 2)
        products = made.synthetic_products() if day == 1 else None
        changes = {"started_utc": f"2026-01-0{day}T00:00:00Z", "name": f"dimes-{site}"}
        directory = made.write_run(folder / f"run-{day}", frame, products=products, **changes)
        record = (directory / "campaign.json").read_text()
        directory.joinpath("campaign.json").write_text(
            record.replace('"configuration": {', f'"configuration": {{"parameters": {{"site": "{site}"}}, ', 1)
        )
        write_report(directory)
    write_site(folder / "site", [folder])
    return folder


def _report(campaigns: Path) -> Path:
    return campaigns / "run-1" / "report.html"


def _index(campaigns: Path) -> Path:
    return campaigns / "site" / "index.html"


def _violations(page: Page) -> list[str]:
    """What axe-core finds against the levels A and AA."""
    found = Axe().run(page, options={"runOnly": {"type": "tag", "values": LEVELS}}).response["violations"]
    return [f"{one['id']}: {node['html']}" for one in found for node in one["nodes"]]


def test_the_verdict_is_the_first_item_to_see(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_report(campaigns))
    headline = page.locator(".headline")
    assert headline.is_visible()
    assert headline.inner_text().split()[0] in ("PASS", "FAIL", "INSUFFICIENT")
    box = headline.bounding_box()
    assert box is not None
    assert box["y"] + box["height"] < 900
    assert "DIMES-VEL" in page.locator("table.verdicts").inner_text()
    assert seen.complaints == []


def test_hovering_shows_a_case_and_a_click_opens_it(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_report(campaigns))
    point = page.locator(".explorer-plot circle.point").nth(5)
    point.scroll_into_view_if_needed()
    box = point.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tip = page.locator(".explorer-tip")
    assert tip.is_visible()
    assert tip.inner_text().startswith("Case ")
    reported = tip.inner_text().split(":")[0]
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert page.locator(".explorer-detail h3").inner_text().startswith(reported)
    assert "marsyard replay" in page.locator(".explorer-detail").inner_text()
    assert seen.complaints == []


def test_a_case_is_opened_by_keyboard_alone(campaigns: Path, open_page: Open) -> None:
    page, _ = open_page(_report(campaigns))
    page.locator("#explorer input").focus()
    page.keyboard.type("3")
    page.keyboard.press("Enter")
    assert page.locator(".explorer-detail h3").inner_text().startswith("Case 3:")
    link = page.locator(".explorer-detail a")
    link.focus()
    page.keyboard.press("Enter")
    assert page.url.endswith("#case-3")
    assert page.locator("#case-3").is_visible()
    page.locator("#explorer input").fill("999999")
    page.keyboard.press("Enter")
    assert "No such case" in page.locator(".explorer-detail").inner_text()


def test_axes_are_chosen(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_report(campaigns))
    across = page.locator("#explorer select").first
    names = across.locator("option").all_inner_texts()
    for name in names:
        across.select_option(label=name)
        assert page.locator(".explorer-plot .point").count() > 250
        assert name in (page.locator(".explorer-plot").text_content() or "")
    assert seen.complaints == []


def test_campaigns_are_filtered(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_index(campaigns))
    rows = page.locator(".campaigns tbody tr:visible")
    latest = page.locator('tr[data-requirement="DIMES-VEL"] .evidence a').first
    assert (rows.count(), latest.inner_text()) == (3, "dimes-gusev")
    page.locator("select[name=site]").select_option("meridiani")
    assert (rows.count(), latest.inner_text()) == (1, "dimes-meridiani")
    assert page.locator("#count").inner_text() == "1 of 3 campaigns"
    page.locator("select[name=site]").select_option("")
    page.locator("input[name=until]").fill("2026-01-01")
    assert rows.count() == 1
    page.locator("input[name=until]").fill("")
    page.locator("input[name=text]").fill("no such name")
    assert rows.count() == 0
    assert "no campaign fits" in page.locator('tr[data-requirement="DIMES-VEL"]').inner_text()
    page.get_by_role("button", name="Clear").click()
    page.wait_for_function("document.getElementById('count').textContent === '3 of 3 campaigns'")
    # behind the latest verdict stand those of other campaigns
    others = page.locator('tr[data-requirement="DIMES-VEL"] .evidence li b')
    assert (others.count(), page.locator('tr[data-requirement="DIMES-VEL"] .evidence li').count()) == (1, 2)
    assert seen.complaints == []


def test_trends_are_those_of_the_campaigns_that_are_left(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_index(campaigns))
    trend = page.locator('tr[data-requirement="DIMES-VEL"] .trend svg')
    of_all = trend.get_attribute("aria-label")
    page.locator("input[name=until]").fill("2026-01-01")
    assert trend.count() == 0
    page.locator("input[name=until]").fill("")
    # drawn anew, it is what the page came with
    assert (trend.count(), trend.get_attribute("aria-label")) == (1, of_all)
    assert page.locator(".coverage").inner_text().count("NO CAMPAIGN") == 1
    assert seen.complaints == []


def test_a_filter_stands_on_the_way_back(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_index(campaigns))
    page.locator("select[name=site]").select_option("meridiani")
    page.locator(".campaigns tbody tr:visible a").first.click()
    page.go_back()
    chosen, shown = page.locator("select[name=site]").input_value(), page.locator(".campaigns tbody tr:visible").count()
    assert (chosen, shown) in {("meridiani", 1), ("", 3)}
    assert seen.complaints == []


def test_two_clicks_lead_from_a_requirement_to_the_worst_cases_pictures(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_index(campaigns))
    page.locator("input[name=until]").fill("2026-01-01")
    page.locator('tr[data-requirement="DIMES-VEL"] .evidence a').first.click()
    page.get_by_role("link", name="Case 3").click()
    assert page.locator("h1").inner_text().startswith("Case 3")
    assert page.locator("#main svg").count() > 0
    folder = (campaigns / "site").resolve().as_uri()
    outside = [url for url in seen.requests if not url.startswith((folder, "data:"))]
    assert outside == []
    assert seen.complaints == []


def test_nothing_is_asked_of_the_network(campaigns: Path, open_page: Open) -> None:
    page, seen = open_page(_report(campaigns))
    page.wait_for_load_state("networkidle")
    assert [url for url in seen.requests if not url.startswith("data:")] == [_report(campaigns).resolve().as_uri()]


# layout depends on the width alone and contrast on the scheme alone: two of the four pairs show both of each
@pytest.mark.parametrize(("width", "scheme"), [(1280, "dark"), (390, "light")])
@pytest.mark.parametrize("what", ["report", "index", "campaign", "case"])
def test_pages_are_accessible_and_fit_the_window(
    campaigns: Path, open_page: Open, what: str, width: int, scheme: str
) -> None:
    site = campaigns / "site"
    case = next(site.rglob("case-3.html"))
    path = {
        "report": _report(campaigns),
        "index": _index(campaigns),
        "campaign": case.parent / "index.html",
        "case": case,
    }
    page, seen = open_page(path[what], width=width, scheme=scheme)
    assert _violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert seen.complaints == []
