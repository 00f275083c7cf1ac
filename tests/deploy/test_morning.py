"""A morning on screen: the demo in a real browser, from learning to alarm to acknowledged to repaired and relearned.

Needs Debian's chromium and playwright; `make pictures` keeps what docs/pages.md shows.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.demo import VEHICLE, made_demo, serving

CHROMIUM = shutil.which("chromium")
FAILED = "secondary_2r.damping"  # by three tenths
PACE = "30"  # times real time: so that somebody can look
FAILING = "720"  # s of the demo: its damper has failed by then
HOUR = "3600"  # s later the repaired vehicle runs again; as long, since lengths of another day draw another vehicle
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]


def kept(page: Any, name: str) -> None:
    """A picture for docs/pages.md, where one is wanted."""
    page.wait_for_timeout(1500)
    if folder := os.environ.get("SPRUNG_SHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)


def eventually(page: Any, address: str, true: Callable[[dict[str, Any]], bool], seconds: float = 1200.0) -> None:
    """Open the vehicle's page as soon as something is true of it."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        answer = page.request.get(f"{address}/vehicles/{VEHICLE}")
        if answer.ok and true(answer.json()):
            page.goto(f"{address}/pages/vehicles/{VEHICLE}#{FAILED}")
            page.reload()  # what is behind the # alone loads nothing
            return
        page.wait_for_timeout(500)
    raise AssertionError("it did not come")


def failed(told: dict[str, Any]) -> bool:
    """Its active alarms name the damper."""
    return any(alarm["parameter"] == FAILED for alarm in told["alarms"])


def learning(told: dict[str, Any]) -> bool:
    """The damper has no baseline."""
    return any(one["name"] == FAILED and one["state"] == "learning" for one in told["parameters"])


def replaying(page: Any, address: str) -> bool:
    """Whether the ride goes on; what is kept of the alarm is a recording, too, and whole at once."""
    recordings = page.request.get(f"{address}/recordings").json()["recordings"]
    return any(one["finished"] is None for one in recordings if one["source"] != "alarm")


def test_a_morning_on_screen(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    (tmp_path / "repaired").mkdir()
    failing = made_demo(tmp_path, "--day", FAILING)
    repaired = made_demo(tmp_path / "repaired", "--later", HOUR, "--day", FAILING, faults=False)
    with (
        serving(failing, tmp_path / "data", "--speed", PACE) as address,
        sync_api.sync_playwright() as driver,
    ):
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        eventually(page, address, learning)
        assert "Learning" in page.inner_text("#summary")
        kept(page, "morning-1-learning")

        eventually(page, address, failed)
        assert f"{FAILED} has changed" in page.inner_text("#summary")
        kept(page, "morning-2-alarm")

        page.get_by_role("button", name="Acknowledge").first.click()
        page.locator("dialog[open] button.first").click()
        while page.request.get(f"{address}/alarms?active=true&acknowledged=false").json()["alarms"]:
            page.wait_for_timeout(300)
        eventually(page, address, failed)
        assert "Acknowledged by local" in page.inner_text("#summary")
        kept(page, "morning-3-acknowledged")

        while replaying(page, address):
            page.wait_for_timeout(1000)
        eventually(page, address, failed)
        page.get_by_role("button", name="Mark maintenance").click()
        page.fill("dialog[open] textarea", "damper secondary_2r exchanged on track 4")
        page.get_by_label("of these").check()
        kept(page, "morning-4-maintenance")
        assert page.locator("select[name=parameters]").evaluate("e => [...e.selectedOptions].map(o => o.value)") == [
            FAILED
        ]
        page.locator("dialog[open] button.first").click()
        eventually(page, address, learning)

        page.goto(f"{address}/pages/work")
        page.set_input_files("#file", repaired)
        page.fill("#vehicle", VEHICLE)
        page.get_by_role("button", name="Upload").click()
        while page.request.get(f"{address}/jobs?state=done").json()["jobs"] == []:
            assert page.request.get(f"{address}/jobs?state=failed").json()["jobs"] == []
            page.wait_for_timeout(1000)
        page.goto(f"{address}/pages/vehicles/{VEHICLE}#{FAILED}")
        page.reload()
        kept(page, "morning-5-relearned")
        assert "good" in page.inner_text("h1")
        told = page.request.get(f"{address}/vehicles/{VEHICLE}").json()
        (mark,) = page.request.get(f"{address}/vehicles/{VEHICLE}/marks").json()["marks"]
        browser.close()
    assert mark["kind"] == "maintenance" and mark["time"] < told["last_window"]  # of the ride
    damper = next(p for p in told["parameters"] if p["name"] == FAILED)
    assert told["health"] == "ok" and damper["drift"] is not None and abs(damper["drift"]) < 0.1
