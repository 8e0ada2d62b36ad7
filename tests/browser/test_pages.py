"""Tests of reports and dashboard in a browser: content, interaction, requests and accessibility."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Page

from marsyard.reports.campaign_report import write_report
from marsyard.reports.dashboard.site import write_site
from tests.reports import synthetic_run
from tests.reports.hda import synthetic_landing
from tests.reports.localisation import synthetic_localisation
from tests.reports.vtt import tracking_rows

pytestmark = pytest.mark.slow

#: Fixture `open_page` of conftest: it opens a file and returns the page and its log.
OpenPage = Callable[..., tuple[Page, Any]]
#: Rule sets of axe-core for WCAG 2.2, levels A and AA.
LEVELS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22a", "wcag22aa"]


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a dashboard of three campaigns, one of them with images of a case."""
    folder = tmp_path_factory.mktemp("campaigns")
    for day, (site, cases) in enumerate((("gusev", 300), ("meridiani", 24), ("gusev", 24)), start=1):
        frame = synthetic_run.make_rows(cases, terrains=1000, seed=day, n_crashed=day == 2)
        products = synthetic_run.synthetic_products() if day == 1 else None
        changes: dict[str, Any] = {"started_utc": f"2026-01-0{day}T00:00:00Z", "name": f"dimes-{site}"}
        directory = synthetic_run.write_run(folder / f"run-{day}", frame, products=products, **changes)
        record = (directory / "campaign.json").read_text()
        directory.joinpath("campaign.json").write_text(
            record.replace('"definition": {', f'"definition": {{"parameters": {{"site": "{site}"}}, ', 1)
        )
        write_report(directory)
    write_site(folder / "site", [folder])
    return folder


def _report_path(campaigns: Path) -> Path:
    return campaigns / "run-1" / "report.html"


def _index_path(campaigns: Path) -> Path:
    return campaigns / "site" / "index.html"


def _find_violations(page: Page) -> list[str]:
    """Return the violations of the levels A and AA that axe-core finds."""
    violations = Axe().run(page, options={"runOnly": {"type": "tag", "values": LEVELS}}).response["violations"]
    return [f"{violation['id']}: {node['html']}" for violation in violations for node in violation["nodes"]]


def test_verdict_is_visible_without_scrolling(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    headline = page.locator(".headline")
    assert headline.is_visible()
    assert headline.inner_text().split()[0] in ("PASS", "FAIL", "INSUFFICIENT")
    box = headline.bounding_box()
    assert box is not None
    assert box["y"] + box["height"] < 900
    assert "DIMES-VEL" in page.locator("table.verdicts").inner_text()
    assert log.messages == []


def test_case_is_shown_on_hover_and_opened_by_click(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    point = page.locator(".explorer-plot circle.point").nth(5)
    point.scroll_into_view_if_needed()
    box = point.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tip = page.locator(".explorer-tip")
    assert tip.is_visible()
    assert tip.inner_text().startswith("Case ")
    case_name = tip.inner_text().split(":")[0]
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert page.locator(".explorer-detail h3").inner_text().startswith(case_name)
    assert "marsyard replay" in page.locator(".explorer-detail").inner_text()
    assert log.messages == []


def test_case_is_opened_by_keyboard(campaigns: Path, open_page: OpenPage) -> None:
    page, _ = open_page(_report_path(campaigns))
    page.locator("#explorer input[type=number]").focus()
    page.keyboard.type("3")
    page.keyboard.press("Enter")
    assert page.locator(".explorer-detail h3").inner_text().startswith("Case 3:")
    link = page.locator(".explorer-detail a")
    link.focus()
    page.keyboard.press("Enter")
    assert page.url.endswith("#case-3")
    assert page.locator("#case-3").is_visible()
    page.locator("#explorer input[type=number]").fill("999999")
    page.keyboard.press("Enter")
    assert "No such case" in page.locator(".explorer-detail").inner_text()


def test_axes_of_the_explorer_are_selectable(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    axis_select = page.locator(".explorer-canvas select").first
    axis_labels = axis_select.locator("option").all_inner_texts()
    plot = page.locator(".explorer-plot").first
    for label in axis_labels:
        axis_select.select_option(label=label)
        assert plot.locator(".point").count() > 250
        assert label in (plot.text_content() or "")
    assert log.messages == []


def test_campaigns_are_filtered(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_index_path(campaigns))
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
    # the verdicts of the other campaigns are listed after the latest verdict
    other_verdicts = page.locator('tr[data-requirement="DIMES-VEL"] .evidence li b')
    assert (other_verdicts.count(), page.locator('tr[data-requirement="DIMES-VEL"] .evidence li').count()) == (1, 2)
    assert log.messages == []


def test_trends_follow_the_filtered_campaigns(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_index_path(campaigns))
    trend = page.locator('tr[data-requirement="DIMES-VEL"] .trend svg')
    label_of_all_campaigns = trend.get_attribute("aria-label")
    page.locator("input[name=until]").fill("2026-01-01")
    assert trend.count() == 0
    page.locator("input[name=until]").fill("")
    # without the filter the trend is drawn again and equals the initial one
    assert (trend.count(), trend.get_attribute("aria-label")) == (1, label_of_all_campaigns)
    assert page.locator(".coverage").inner_text().count("NO CAMPAIGN") == 1
    assert log.messages == []


def test_filter_is_consistent_after_browser_back(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_index_path(campaigns))
    page.locator("select[name=site]").select_option("meridiani")
    page.locator(".campaigns tbody tr:visible a").first.click()
    page.go_back()
    selected_site = page.locator("select[name=site]").input_value()
    n_rows = page.locator(".campaigns tbody tr:visible").count()
    # a browser may restore the filter or clear it
    assert (selected_site, n_rows) in {("meridiani", 1), ("", 3)}
    assert log.messages == []


@pytest.mark.parametrize("system", ["descent", "landing", "rover", "localisation"])
def test_one_click_leads_from_the_report_to_the_images_of_a_violation(
    system: str, tmp_path: Path, open_page: OpenPage
) -> None:
    frame, products, metric = _make_case_with_images(system)
    requirement = {"id": "R", "metric": metric, "probability": 0.9, "confidence": 0.9, "population": "all"}
    frame[metric] = frame["case"] != 3
    directory = synthetic_run.write_run(tmp_path, frame, [requirement], products=products)
    shutil.copytree(directory / "cases" / "3", directory / "cases" / "5")
    page, log = open_page(write_report(directory))
    # with several cases, their images are folded
    assert not page.locator("#case-3 svg").first.is_visible()
    thumbnail = page.locator("#violations img")
    assert thumbnail.evaluate("image => image.naturalWidth") == 96
    page.locator("#violations").get_by_role("link", name="Case 3").click()
    assert page.locator("#case-3 svg").first.is_visible()
    assert "violated" in page.locator("#case-3").inner_text()
    assert log.messages == []


def _make_case_with_images(system: str) -> tuple[pd.DataFrame, dict[str, Any], str]:
    """Return rows of a system, products of case 3, and the metric of a requirement."""
    if system == "descent":
        return synthetic_run.make_rows(24), synthetic_run.synthetic_products(), "answered"
    if system == "landing":
        return synthetic_landing.landing_frame(24), synthetic_landing.synthetic_products(), "site_safe"
    if system == "rover":
        return tracking_rows.make_rows(24), tracking_rows.make_products(), "tracked"
    products = synthetic_localisation.synthetic_products()
    return synthetic_localisation.localisation_frame(24), products, "fixed_in_time"


def test_brushed_cases_are_marked_in_both_plots(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    first, second = (page.locator(".explorer-plot").nth(index) for index in (0, 1))
    first.scroll_into_view_if_needed()
    box = first.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.2 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 0.6 * box["height"], steps=4)
    page.mouse.up()
    text = page.locator(".explorer-selection").inner_text()
    n_selected = int(text.split()[0])
    assert 0 < n_selected < 250
    for plot in (first, second):
        assert plot.locator(".point:not(.faded)").count() <= n_selected
        assert plot.locator(".point.faded").count() > 20
    page.get_by_role("button", name="Clear the selection").click()
    assert page.locator(".point.faded").count() == 0
    assert log.messages == []


def test_points_are_filtered_by_outcome_and_marked_by_requirement(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    points = page.locator(".explorer-plot").nth(1).locator(".point")
    n_all = points.count()
    page.locator("select[name=outcome]").select_option(label="NO_VALID_TRACK")
    assert 0 < points.count() < n_all
    page.locator("select[name=outcome]").select_option(label="all")
    assert points.count() == n_all
    assert page.locator("select[name=colour] option").all_inner_texts() == ["DIMES-VEL"]
    assert log.messages == []


def test_short_campaign_has_a_short_page(campaigns: Path, open_page: OpenPage) -> None:
    page, _ = open_page(campaigns / "run-2" / "report.html")
    assert page.evaluate("document.documentElement.scrollHeight") <= 6000
    navigation = page.locator("nav > ul").bounding_box()
    assert navigation is not None
    assert navigation["height"] < 60


def test_two_clicks_lead_to_images_of_the_worst_case(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_index_path(campaigns))
    page.locator("input[name=until]").fill("2026-01-01")
    page.locator('tr[data-requirement="DIMES-VEL"] .evidence a').first.click()
    page.get_by_role("link", name="Case 3").click()
    assert page.locator("h1").inner_text().startswith("Case 3")
    assert page.locator("#main svg").count() > 0
    folder = (campaigns / "site").resolve().as_uri()
    external_requests = [url for url in log.requests if not url.startswith((folder, "data:"))]
    assert external_requests == []
    assert log.messages == []


def test_report_sends_no_network_requests(campaigns: Path, open_page: OpenPage) -> None:
    page, log = open_page(_report_path(campaigns))
    page.wait_for_load_state("networkidle")
    assert [url for url in log.requests if not url.startswith("data:")] == [_report_path(campaigns).resolve().as_uri()]


@pytest.mark.parametrize("width", [1280, 820, 360])
def test_percentiles_of_a_case_are_not_cut_off(campaigns: Path, open_page: OpenPage, width: int) -> None:
    page, _ = open_page(next((campaigns / "site").rglob("case-3.html")), width=width)
    # the longest name of a condition must wrap instead of moving the percentiles out of the section
    page.locator(".case-summary tbody th").evaluate_all(
        "cells => { for (const cell of cells) cell.textContent = 'maximum '.repeat(12) }"
    )
    section = page.locator("#main section").first.bounding_box()
    assert section is not None
    for cell in page.locator(".case-summary tbody td:last-child").all():
        box = cell.bounding_box()
        assert box is not None
        assert box["x"] + box["width"] <= section["x"] + section["width"]


# Layout depends on the width, contrast on the scheme: two of the four combinations cover both.
@pytest.mark.parametrize(("width", "scheme"), [(1280, "dark"), (390, "light")])
@pytest.mark.parametrize("page_kind", ["report", "index", "campaign", "case"])
def test_pages_are_accessible_and_fit_the_window(
    campaigns: Path, open_page: OpenPage, page_kind: str, width: int, scheme: str
) -> None:
    site = campaigns / "site"
    case = next(site.rglob("case-3.html"))
    path = {
        "report": _report_path(campaigns),
        "index": _index_path(campaigns),
        "campaign": case.parent / "index.html",
        "case": case,
    }
    page, log = open_page(path[page_kind], width=width, scheme=scheme)
    assert _find_violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert log.messages == []
