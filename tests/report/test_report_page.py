"""The report's page in a browser: contents, no network access, escaped texts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from support.pages import Opened, scroll_through, watched
from support.reports import HOSTILE, REASON, Recipe, payload_of, write_page
from support.web import axe_script

from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.keypointnet import KeypointNetOptions
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.report import write_report
from cadalign.web import asset

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def drawn(browser: Browser, plain: str) -> Iterator[Page]:
    """The page of an ordinary run, with all plots drawn; tests must not change it."""
    with watched(browser) as open_page:
        page = open_page(plain)
        assert page.locator(".plot[data-drawn]").count() < 2  # the others are not in view
        scroll_through(page)
        yield page


def test_all_contents_of_a_run_are_shown(drawn: Page) -> None:
    page = drawn
    expect(page).to_have_title("A report of chairs")
    expect(page.locator(".lead")).to_contain_text("24 views of chairs")
    table = page.locator("table.headline")
    expect(table.locator("tbody")).to_have_count(3)
    # The best value is marked by weight and text, not only by a tint.
    assert table.locator("b.best").count() == 15
    assert table.locator("b.best").first.inner_text().endswith("(best)")
    assert page.locator("b.best").first.evaluate("(e) => getComputedStyle(e).fontWeight") == "700"
    failures = page.locator(".failures")
    failures.locator("summary").click()
    expect(failures.locator("tbody")).to_contain_text(REASON)
    assert [plot.get_attribute("id") for plot in page.locator(".plot").all()] == [
        "plot-rotation_error_deg",
        "plot-translation_error",
    ]
    expect(page.locator(".found")).to_have_text("24 instances")
    page.locator("#gallery").scroll_into_view_if_needed()
    expect(page.locator(".card")).to_have_count(24)


@pytest.mark.parametrize(
    ("recipe", "found"),
    [
        pytest.param(Recipe(failures=1.0), "24 instances", id="nothing-succeeds"),
        pytest.param(Recipe(instances=1, categories=("chair",)), "1 instance", id="one-instance"),
        pytest.param(Recipe(exhibits=False), "24 instances", id="no-poses"),
        pytest.param(Recipe(pictures=0), "24 instances", id="no-pictures"),
        pytest.param(Recipe(exhibits=False, pictures=0), "24 instances", id="numbers-only"),
        pytest.param(Recipe(done=9), "24 instances", id="unfinished"),
    ],
)
def test_runs_with_failures_are_shown(
    opened: Opened, tmp_path: Path, recipe: Recipe, found: str
) -> None:
    page = opened(write_page(tmp_path / "report.html", recipe))
    expect(page.locator("#gallery .found")).to_have_text(found)
    if recipe.failures == 1 or recipe.instances == 1:
        scroll_through(page)
    card = page.locator(".card").first
    if recipe.failures == 1:
        expect(card.locator(".failed")).to_have_text(["failed"] * 3)
        expect(page.locator("table.headline tbody tr").nth(1)).to_contain_text("\N{EN DASH}")
    if recipe.pictures == 0:
        kept = ".overlay .box.gt" if recipe.exhibits else "text=no picture"
        expect(card.locator(kept)).to_have_count(1)
    if recipe.done:
        expect(page.locator(".warning")).to_contain_text("9 of 24 instances are done")
    card.click()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator("table").first).to_contain_text("optimal")
    if recipe.failures == 1:
        expect(dialog.locator("table").first).to_contain_text(REASON)
    if not recipe.exhibits and not recipe.pictures:
        expect(dialog).to_contain_text("kept no picture and no poses")


def test_a_run_without_any_results_says_so(opened: Opened, tmp_path: Path) -> None:
    nothing = {"headline": {"columns": [], "rows": []}, "tables": None}
    page = opened(write_page(tmp_path / "report.html", Recipe(done=0), **nothing))
    expect(page.locator("#results")).to_contain_text("No results yet")
    expect(page.locator("#gallery")).to_have_count(0)


def test_texts_from_data_are_escaped(opened: Opened, tmp_path: Path) -> None:
    payload = payload_of(Recipe(models=[HOSTILE], runs=2, failures=0.3))
    text = json.dumps(payload)
    hostile = json.dumps(HOSTILE)[1:-1]
    for word in ("chair", REASON, "optimal", "rotation error", "runs/a", "1 px"):
        text = text.replace(json.dumps(word), json.dumps(f"{HOSTILE} {word}"))
    for word in ("views of chairs", "A report of", "seen end-on", "Medians.", "Share of"):
        text = text.replace(word, f"{hostile} {word}")
    page = opened(write_page(tmp_path / "report.html", Recipe(), **json.loads(text)))
    scroll_through(page)
    for details in page.locator("details").all():
        details.evaluate("(details) => { details.open = true; }")
    page.locator("input[type=search]").fill("<img")
    expect(page.locator("#gallery .found")).to_have_text("2 instances of 48")
    # Names are not markup of the plots either: they are drawn literally.
    expect(page.locator("#plot-rotation_error_deg .xtitle")).to_contain_text(HOSTILE)
    page.locator("#plot-rotation_error_deg").hover()
    page.locator(".card").first.click()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator("h2")).to_have_text(HOSTILE)
    for place in ("h1", ".lead", "table.headline", ".failures", "#plots h3", ".bar", "#gallery"):
        expect(page.locator(place).first).to_contain_text(HOSTILE)
    expect(dialog).to_contain_text(HOSTILE)
    assert page.locator("img[src=x], [onerror], .plot img, .plot image").count() == 0
    assert "</script" not in asset("report.js")


def test_switches_change_all_plots_and_the_gallery(opened: Opened, plain: str) -> None:
    page = opened(plain)
    scroll_through(page)
    lines = (
        "document.getElementById('plot-rotation_error_deg').data.filter(({ name }) => name).length"
    )
    assert page.evaluate(lines) == 3
    chip = page.get_by_role("button", name="aepnp-paper")
    chip.click()
    expect(chip).to_have_attribute("aria-pressed", "false")
    page.wait_for_function(f"{lines} === 2")
    expect(page.locator(".card").first.locator(".error")).to_have_count(2)


@pytest.fixture(scope="module")
def two_runs(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page of two runs, with all plots drawn and a dialog open."""
    with watched(browser) as open_page:
        page = open_page(write_page(tmp_path_factory.mktemp("two") / "report.html", Recipe(runs=2)))
        scroll_through(page)
        page.locator(".card").first.click()
        yield page


def test_two_runs_are_shown_beside_each_other(two_runs: Page) -> None:
    page = two_runs
    expect(page.locator("#gallery .found")).to_have_text("48 instances")
    expect(page.locator("dialog[open] table").first).to_contain_text("optimal")
    names = "document.getElementById('plot-rotation_error_deg').data.map(({ name }) => name)"
    assert len(set(page.evaluate(names))) == 6
    caption = page.locator("dialog[open] .flat figcaption")
    for run in ("runs/a", "runs/b"):
        page.locator("dialog[open]").get_by_role("radio", name=run).check()
        expect(caption).to_contain_text(run)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(opened: Opened, tmp_path: Path, scheme: str) -> None:
    """Accessibility: names of controls, contrast, and more."""
    page = opened(write_page(tmp_path / "report.html", Recipe(runs=2)), color_scheme=scheme)
    scroll_through(page)
    page.evaluate(axe_script())
    assert serious(page) == []
    page.locator(".card").first.click()
    expect(page.locator("dialog canvas")).to_be_visible()
    assert serious(page) == []


def serious(page: Page) -> list[str]:
    """Serious findings of axe, except in plots, whose markup is Plotly's."""
    found = page.evaluate("axe.run({ exclude: ['.plot'] }, { resultTypes: ['violations'] })")
    found = found["violations"]
    bad = [each for each in found if each["impact"] in ("serious", "critical")]
    return [f"{each['id']}: {node['html']}" for each in bad for node in each["nodes"]]


def test_tables_begin_with_all_and_are_whole_at_1440_pixels(opened: Opened, tmp_path: Path) -> None:
    address = write_page(tmp_path / "report.html", Recipe(categories=("bottle", "airplane", "all")))
    page = opened(address, viewport={"width": 1440, "height": 900})
    groups = page.locator("table.headline tr.group")
    expect(groups.first).to_contain_text("all")
    expect(groups).to_have_count(3)
    for scroller in page.locator(".scroller").all():
        assert scroller.evaluate("(e) => e.scrollWidth - e.clientWidth") <= 0


def test_a_phone_shows_the_whole_page(opened: Opened, tmp_path: Path) -> None:
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    page = opened(
        write_page(tmp_path / "report.html", Recipe(runs=2, models=[HOSTILE * 3])), **phone
    )
    scroll_through(page)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    table = page.locator("#results .scroller").first
    before = table.locator("tbody th").nth(1).bounding_box()
    table.evaluate("(e) => e.scrollTo(200, 0)")
    assert table.locator("tbody th").nth(1).bounding_box() == before  # the first column stays
    page.locator(".card").first.tap()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator("canvas")).to_be_visible()
    assert dialog.evaluate("(e) => e.scrollWidth - e.clientWidth") == 0


def test_paper_gets_tables_plots_and_a_few_cards(
    opened: Opened, plain: str, tmp_path: Path
) -> None:
    page = opened(plain, color_scheme="dark")
    page.pdf(path=tmp_path / "page.pdf", print_background=True)
    assert (tmp_path / "page.pdf").read_bytes()[:5] == b"%PDF-"
    # All plots were drawn for printing, though no plot was in view.
    for plot in page.locator(".plot").all():
        expect(plot).to_have_attribute("data-drawn", re.compile(r"\d"))
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    ground, ink = page.locator(".panel").first.evaluate(
        "(e) => [getComputedStyle(e).backgroundColor, getComputedStyle(e).color]"
    )
    assert ground == "rgb(255, 255, 255)"
    assert ink == "rgb(27, 29, 33)"
    expect(page.locator(".filters").first).to_be_hidden()
    expect(page.locator("table.headline")).to_be_visible()
    assert sum(card.is_visible() for card in page.locator(".cards > li").all()) == 12


@pytest.mark.long
def test_a_real_run_makes_a_page(opened: Opened, sample_root: Path, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    options = KeypointNetOptions(
        sample_root,
        categories=("chair",),
        render="overlay",
        max_models=1,
        methods=("optimal", "limit"),
    )
    do_run(options, folder, workers=0, dask=None)
    page = opened(write_report([folder.path], tmp_path / "page.html").as_uri())
    expect(page.locator("table.headline tbody")).not_to_have_count(0)
    page.locator(".card").first.click()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator(".overlay image")).to_have_count(1)
    expect(dialog.locator(".overlay .box")).to_have_count(2)
    dialog.get_by_label("wireframe").check()
    expect(dialog.locator(".overlay .wire")).to_have_count(2)
    expect(dialog.locator("canvas")).to_be_visible()
    expect(dialog).to_contain_text("Estimate of optimal")
