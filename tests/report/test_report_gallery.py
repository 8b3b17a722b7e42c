"""The report's gallery in a real browser: sorting, filtering, links, comparing, many instances."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from support.pages import Opened, Shown, card_names, open_first, page_yardstick, scroll_through
from support.reports import Recipe, listed, payload_of, write_page
from support.timing import Measure, reference_seconds

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_page(tmp_path_factory.mktemp("two") / "report.html", Recipe(runs=2))


def test_worst_best_and_random_are_one_click_away(shown: Shown) -> None:
    page = shown("")
    instances = listed(payload_of(Recipe()), "rotation_error_deg")
    worst = sorted(instances, key=lambda i: -np.inf if i["error"] is None else -i["error"])
    assert card_names(page)[:12] == [i["model"] for i in worst][:12]
    page.get_by_role("button", name="Best", exact=True).click()
    best = sorted(instances, key=lambda i: np.inf if i["error"] is None else i["error"])
    assert card_names(page)[:12] == [i["model"] for i in best][:12]
    page.locator("#gallery").get_by_role("combobox", name="by", exact=True).select_option("box_iou")
    overlaps = listed(payload_of(Recipe()), "box_iou")
    best = sorted(overlaps, key=lambda i: np.inf if i["error"] is None else -i["error"])
    assert card_names(page)[:12] == [i["model"] for i in best][:12]
    random = page.get_by_role("button", name="Random")
    random.click()
    first = card_names(page)
    page.reload()
    page.locator("html[data-ready]").wait_for()
    assert card_names(page)[:12] == first[:12]  # a link shows the same draw
    random.click()
    assert card_names(page)[:12] != first[:12]


def test_filters_keep_what_they_say(shown: Shown) -> None:
    page = shown("")
    gallery = page.locator("#gallery")
    instances = listed(payload_of(Recipe()), "rotation_error_deg")

    def expect_found(keeps: Any) -> None:
        kept = {i["model"] for i in instances if keeps(i)}
        count = f"{len(kept)} instances of 24" if len(kept) != 1 else "1 instance of 24"
        expect(gallery.locator(".found")).to_have_text(count)
        assert set(card_names(page)[:12]) <= kept

    gallery.get_by_label("category").select_option("chair")
    expect_found(lambda i: i["category"] == "chair")
    gallery.get_by_label("status").select_option("failed")
    expect_found(lambda i: i["category"] == "chair" and i["error"] is None)
    gallery.get_by_role("button", name="Clear filters").click()
    gallery.get_by_label("keypoints, from").fill("6")
    gallery.get_by_label("keypoints, to").fill("8")
    expect_found(lambda i: 6 <= i["keypoints"] <= 8)
    gallery.get_by_label("rotation error [deg], to").fill("0.6")
    expect_found(
        lambda i: 6 <= i["keypoints"] <= 8 and i["error"] is not None and i["error"] <= 0.6
    )
    gallery.get_by_role("button", name="Clear filters").click()
    gallery.get_by_role("combobox", name="of", exact=True).select_option("*")
    gallery.get_by_label("status").select_option("ok")
    three = [listed(payload_of(Recipe()), "rotation_error_deg", method) for method in range(3)]
    good = sum(all(i["error"] is not None for i in tried) for tried in zip(*three, strict=True))
    expect(gallery.locator(".found")).to_have_text(f"{good} instances of 24")
    gallery.get_by_role("button", name="Clear filters").click()
    model = instances[5]["model"]
    gallery.get_by_label("model id").fill(model[:6].upper())
    expect_found(lambda i: model[:6] in i["model"])
    gallery.get_by_label("model id").fill("nothing is called so")
    expect(gallery.locator(".found")).to_have_text("No instance passes these filters.")
    assert gallery.locator(".found").get_attribute("role") == "status"


def test_the_fragment_restores_the_view(opened: Opened, shown: Shown) -> None:
    page = shown("")
    gallery = page.locator("#gallery")
    gallery.get_by_label("category").select_option("vessel")
    page.get_by_role("button", name="Best", exact=True).click()
    gallery.get_by_label("model id").fill("e")
    page.get_by_role("button", name="aepnp-paper").click()
    page.locator("#plots select").select_option("translation_error")
    dialog = open_first(page)
    dialog.get_by_label("wireframe").check()
    dialog.get_by_label("keypoints").uncheck()
    dialog.get_by_role("radio", name="aepnp", exact=True).check()
    title, cards = dialog.locator("h2").inner_text(), card_names(page)
    other = opened(page.url)
    dialog = other.locator("dialog[open]")
    expect(dialog.locator("h2")).to_have_text(title)
    expect(dialog.get_by_label("wireframe")).to_be_checked()
    expect(dialog.get_by_label("keypoints")).not_to_be_checked()
    expect(dialog.get_by_role("radio", name="aepnp", exact=True)).to_be_checked()
    expect(other.locator(".card .name")).to_have_text(cards)
    expect(other.locator("#plots h3").first).to_contain_text("translation error")
    expect(other.locator(".chip[aria-pressed=false]")).to_have_text("aepnp-paper")
    other.keyboard.press("Escape")
    expect(other.locator("dialog[open]")).to_have_count(0)
    # A link followed within the page works too, and nonsense in one does no harm.
    other.evaluate("location.hash = '#q=&category=bottle&order=nonsense&open=nobody&kmin=many'")
    expect(other.locator("#gallery .found")).to_have_text("8 instances of 24")


def test_runs_are_compared_by_what_changed_most(opened: Opened, two_runs: str) -> None:
    page = opened(two_runs)
    instances = listed(payload_of(Recipe(runs=2)), "rotation_error_deg")
    before = {i["id"]: i for i in instances if i["run"] == 0}
    after = {i["id"]: i for i in instances if i["run"] == 1}

    def change(key: int) -> float:
        a, b = before[key]["error"], after[key]["error"]
        if a is None or b is None:
            return 0.0 if a is b else np.inf
        return abs(b - a)

    order = sorted(before, key=lambda key: -change(key))
    pairs = page.locator(".pair")
    expect(pairs).to_have_count(12)
    models = pairs.locator(".name").all_inner_texts()
    both = [k for k in order if before[k]["error"] is not None and after[k]["error"] is not None]
    most = order.index(both[0])
    assert models == [before[key]["model"] for key in order[:12]]
    page.get_by_role("button", name="Show more").click()
    expect(pairs).to_have_count(24)
    pairs.nth(most).click()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator("h2")).to_have_text(models[most])
    expect(dialog.locator("svg.overlay")).to_have_count(2)
    expect(dialog.locator(".flat figcaption")).to_have_text(
        ["runs/b \u00b7 optimal", "runs/a \u00b7 optimal"]
    )
    dialog.get_by_role("radio", name="runs/a").check()
    expect(dialog.locator(".flat figcaption").first).to_contain_text("runs/a")
    page.keyboard.press("Escape")
    scroll_through(page)
    dots = page.evaluate(
        "document.getElementById('plot-pairs').data.slice(1)"
        ".flatMap(({ x, y }) => x.map((value, i) => [value, y[i]]))"
    )
    expected = [[before[k]["error"], after[k]["error"]] for k in both]
    np.testing.assert_allclose(sorted(dots), sorted(expected))
    page.locator("#plot-pairs .point").first.click(force=True)
    expect(page.locator("dialog[open] svg.overlay")).to_have_count(2)


def without_overlaps(payload: dict[str, Any]) -> dict[str, Any]:
    """The payload's tables with the first 6 instances of each run aligned, but without box IoU."""
    tables = payload["tables"]
    rows = tables["rows"]
    for row, instance in enumerate(rows["instance"]):
        if tables["instances"]["id"][instance] < 6:
            rows["status"][row], rows["reason"][row], rows["box_iou"][row] = 0, -1, None
    return tables


def test_a_good_fit_without_a_value_is_listed_last_and_not_as_failed(
    opened: Opened, tmp_path: Path
) -> None:
    tables = without_overlaps(payload_of(Recipe(failures=0.3)))
    address = write_page(tmp_path / "report.html", Recipe(failures=0.3), tables=tables)
    page = opened(address, viewport={"width": 1280, "height": 6000})  # all cards are in view
    gallery = page.locator("#gallery")
    gallery.get_by_role("combobox", name="by", exact=True).select_option("box_iou")
    instances = listed({"tables": tables}, "box_iou")
    failed = [i for i in instances if i["error"] is None and i["id"] >= 6]
    fitted = sorted((i for i in instances if i["error"] is not None), key=lambda i: i["error"])
    assert failed
    for order, expected in (
        ("Worst", [*failed, *fitted, *instances[:6]]),
        ("Best", [*fitted[::-1], *failed, *instances[:6]]),
    ):
        page.get_by_role("button", name=order, exact=True).click()
        expect(page.locator(".card .name")).to_have_text([i["model"] for i in expected])
    card = gallery.locator(".card", has_text=instances[0]["model"])
    expect(card.locator(".error").first).to_contain_text("\u2013")
    expect(card.locator(".failed")).to_have_count(0)


def test_a_fit_without_a_value_is_compared_with_nothing(opened: Opened, tmp_path: Path) -> None:
    recipe = Recipe(runs=2, failures=0.3)
    tables = without_overlaps(payload_of(recipe))
    page = opened(write_page(tmp_path / "report.html", recipe, tables=tables) + "#by=box_iou")
    page.get_by_role("button", name="Show more").click()
    instances = listed({"tables": tables}, "box_iou")
    for index, instance in enumerate(instances[:24]):
        card = page.locator(".pair", has_text=instance["model"])
        expect(card).to_have_count(1)
        values = card.locator(".side strong").all_inner_texts()
        nothing = card.get_by_text("nothing to compare", exact=True)
        if index < 6:
            assert values == ["\u2013", "\u2013"]
        else:
            both = (instance, instances[24 + index])
            assert [value == "failed" for value in values] == [i["error"] is None for i in both]
        expect(nothing).to_have_count(int(index < 6))
    found = page.locator("#compare .found")
    expect(found).to_have_text(re.compile(r"24 instances in both: .* the same, 6 without a value"))


def heavier(address: str, size: int) -> str:
    """A picture's address with bytes after its end, which no reader minds."""
    head, data = address.split(",")
    return f"{head},{base64.b64encode(base64.b64decode(data) + bytes(size)).decode()}"


def opening_of(page: Page) -> Measure:
    """Measure how long a page takes until it is ready, opened anew."""

    def measure() -> float:
        page.reload()
        page.locator("html[data-ready]").wait_for()
        return float(page.evaluate("performance.now()")) / 1000

    return measure


@pytest.mark.timing
def test_a_thousand_instances_are_usable_within_two_seconds(opened: Opened, tmp_path: Path) -> None:
    payload = payload_of(Recipe(instances=1000))
    # Every instance has a picture of its own, as large as real ones are.
    for kind, size in (("pictures", 9_000), ("thumbs", 3_000)):
        few = [heavier(payload[kind][str(i)], size) for i in range(6)]
        payload[kind] = {str(i): few[i % 6] for i in range(1000)}
    payload["tables"]["instances"]["thumb"] = list(range(1000))
    address = write_page(tmp_path / "report.html", Recipe(), **payload)
    assert (tmp_path / "report.html").stat().st_size < 3_000_000 + 1000 * 60_000
    page = opened(address)
    assert reference_seconds(opening_of(page), below=2, by=page_yardstick(page.context)) < 2
    expect(page.locator("#gallery .found")).to_have_text("1,000 instances")
    page.locator("#gallery").get_by_label("category").select_option("chair")
    expect(page.locator("#gallery .found")).to_have_text("333 instances of 1,000")


@pytest.mark.long
@pytest.mark.timing
def test_ten_thousand_instances_with_assets_open_and_scroll(opened: Opened, tmp_path: Path) -> None:
    payload = payload_of(Recipe(instances=10_000, exhibits=False, categories=("chair",)))
    payload["tables"]["instances"]["exhibit"] = list(range(10_000))
    exhibits = payload_of(Recipe())["exhibits"]
    (tmp_path / "exhibits_0000.js").write_text(
        "".join(f"cadalignExhibit({k}, {json.dumps(exhibits[str(k)])});" for k in range(24))
    )
    (tmp_path / "mesh_0.js").write_text(
        f"cadalignMesh('m0', {json.dumps(payload['meshes']['m0'])})"
    )
    payload |= {"exhibit_files": ["exhibits_0000.js"] * 157, "exhibits_per_file": 64}
    payload |= {"mesh_files": {"m0": "mesh_0.js"}}
    del payload["exhibits"], payload["meshes"]
    page = opened(write_page(tmp_path / "report.html", Recipe(instances=0), **payload))
    assert reference_seconds(opening_of(page), below=3, by=page_yardstick(page.context)) < 3
    expect(page.locator("#gallery .found")).to_have_text("10,000 instances")
    assert page.locator(".card").count() < 100
    page.locator("#gallery").scroll_into_view_if_needed()
    page.evaluate("scrollBy(0, 500_000)")
    expect(page.locator(".cards > li").last).to_have_attribute("data-place", re.compile(r"\d{4}"))
    assert page.locator(".card").count() < 100
    page.evaluate("location.hash = '#order=listed'")
    page.evaluate("scrollTo(0, 0)")
    dialog = open_first(page)
    dialog.get_by_label("wireframe").check()
    expect(dialog.locator(".overlay .wire")).to_have_count(2)
