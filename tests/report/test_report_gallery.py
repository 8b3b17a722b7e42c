"""The report's gallery in a browser: order, filters, links, comparison, many instances."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import expect
from support.pages import Opened, Shown, card_names, open_first
from support.reports import METHODS, Recipe, listed, payload_of, write_page

pytestmark = pytest.mark.long


def test_the_worst_and_the_best_come_first(shown: Shown) -> None:
    page = shown("")
    gallery = page.locator("#gallery")
    instances = listed(payload_of(Recipe()), "rotation_error_deg")
    worst = sorted(instances, key=lambda i: -np.inf if i["error"] is None else -i["error"])
    assert card_names(page)[:12] == [i["model"] for i in worst][:12]
    gallery.get_by_label("order").select_option("best")
    best = sorted(instances, key=lambda i: np.inf if i["error"] is None else i["error"])
    assert card_names(page)[:12] == [i["model"] for i in best][:12]
    gallery.get_by_role("combobox", name="by", exact=True).select_option("box_iou")
    overlaps = listed(payload_of(Recipe()), "box_iou")
    best = sorted(overlaps, key=lambda i: np.inf if i["error"] is None else -i["error"])
    assert card_names(page)[:12] == [i["model"] for i in best][:12]


def test_filters_select_instances(shown: Shown) -> None:
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
    gallery.get_by_role("button", name="Clear filters").click()
    gallery.get_by_role("combobox", name="of", exact=True).select_option("aepnp")
    gallery.get_by_label("status").select_option("failed")
    tried = listed(payload_of(Recipe()), "rotation_error_deg", METHODS.index("aepnp"))
    failed = {i["model"] for i in tried if i["error"] is None}
    expect_found(lambda i: i["model"] in failed)
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
    gallery.get_by_label("order").select_option("best")
    gallery.get_by_label("model id").fill("e")
    page.get_by_role("button", name="aepnp-paper").click()
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
    expect(other.locator(".chip[aria-pressed=false]")).to_have_text("aepnp-paper")
    other.keyboard.press("Escape")
    expect(other.locator("dialog[open]")).to_have_count(0)
    # Links within the page work too; invalid values in a link are ignored.
    other.evaluate("location.hash = '#q=&category=bottle&order=nonsense&open=nobody&run=many'")
    expect(other.locator("#gallery .found")).to_have_text("8 instances of 24")


def without_overlaps(payload: dict[str, Any]) -> dict[str, Any]:
    """Tables of the payload; the first 6 instances of each run have results without box IoU."""
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
    page = opened(address)
    gallery = page.locator("#gallery")
    gallery.get_by_role("combobox", name="by", exact=True).select_option("box_iou")
    instances = listed({"tables": tables}, "box_iou")
    failed = [i for i in instances if i["error"] is None and i["id"] >= 6]
    fitted = sorted((i for i in instances if i["error"] is not None), key=lambda i: i["error"])
    assert failed
    for order, expected in (
        ("worst", [*failed, *fitted, *instances[:6]]),
        ("best", [*fitted[::-1], *failed, *instances[:6]]),
    ):
        gallery.get_by_label("order").select_option(order)
        expect(page.locator(".card .name")).to_have_text([i["model"] for i in expected])
    card = gallery.locator(".card", has_text=instances[0]["model"])
    expect(card.locator(".error").first).to_contain_text("\u2013")
    expect(card.locator(".failed")).to_have_count(0)


def test_many_instances_are_shown_in_parts(opened: Opened, tmp_path: Path) -> None:
    page = opened(write_page(tmp_path / "report.html", Recipe(instances=120)))
    expect(page.locator("#gallery .found")).to_have_text("120 instances")
    cards = page.locator(".card")
    expect(cards).to_have_count(48)
    page.get_by_role("button", name="Show more").click()
    expect(cards).to_have_count(96)
    page.locator("#gallery").get_by_label("category").select_option("chair")
    expect(page.locator("#gallery .found")).to_have_text("40 instances of 120")
    expect(cards).to_have_count(40)
