"""The pages in a real browser: nothing leaves the machine, nothing is wide or wrong, everything can be reached by keys.

Needs Debian's chromium and playwright; `make pictures` keeps what docs/pages.md shows.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from sprung.model.diagnosis.report.report import LawParameter
from sprung.model.system import MANCHESTER, System, load_system
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.monitoring.engine import Engine
from sprung.service.processes.worker import Emit
from sprung.service.report.writing import write_report
from sprung.service.settings import Settings
from sprung.service.store import work
from sprung.service.store.circumstances import WindowCircumstances, add_circumstances
from sprung.service.store.lists import list_jobs
from sprung.service.store.schema import fleet_status
from sprung.service.store.status import fleet_row
from sprung.service.times import now_ns, to_iso
from tests.oidc_provider import provider_settings, running_provider
from tests.report_made import friction_report
from tests.service_fakes import REPORT, STANDING, START, make_window

CHROMIUM = shutil.which("chromium")
PAGES = {"fleet": "/", "vehicle": "/pages/vehicles/car-17", "work": "/pages/work", "signin": "/signin"}
PAGES |= {"alarms": "/pages/alarms"}
MOST_BYTES = 300_000  # of the first load of the vehicle's page
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]


@contextmanager
def serving(core: Core) -> Iterator[str]:
    """The address of the service around a core."""
    server = uvicorn.Server(uvicorn.Config(create_app(core), port=0, log_level="warning", lifespan="on"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        thread.join(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(20)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, system: System) -> Iterator[tuple[str, Core]]:
    """A running service with an alarmed vehicle and a good one."""
    from sprung.model.system import MANCHESTER_DBC
    from sprung.service.monitoring.engine import make_tracker
    from tests.service_fakes import FakeIdentifier

    engine = Engine(system, FakeIdentifier(system), make_tracker(system), MANCHESTER_DBC)
    core = build_core(Settings(data_dir=tmp_path_factory.mktemp("data")), engine)
    with serving(core) as address:
        _rides(core, system)
        yield address, core


def _rides(core: Core, system: System) -> None:
    core.pipeline.process("car-17", [make_window(system, i) for i in range(80)])
    core.pipeline.process("car-17", [make_window(system, 80 + i, 0.3) for i in range(60)])
    core.pipeline.process("car-18", [make_window(system, i) for i in range(80)])
    ran = [
        WindowCircumstances(START + i * 10**9, {"car.load": 4e3 + 30.0 * i, "temperature": 12 + i / 40})
        for i in range(140)
    ]
    with core.store.write() as connection:
        add_circumstances(connection, {"car-17": ran}, START)


@pytest.fixture(scope="module")
def address(served: tuple[str, Core]) -> str:
    return served[0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 800, 380])
@pytest.mark.parametrize("name", PAGES)
def test_pages_stay_at_home_fit_their_screen_and_say_no_error(
    address: str, browser: Any, name: str, width: int, scheme: str
) -> None:
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    outside: list[str] = []
    errors: list[str] = []
    page.on(
        "request",
        lambda asked: None if asked.url.startswith((address, "data:", "blob:")) else outside.append(asked.url),
    )
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    answer = page.goto(address + PAGES[name], wait_until="load")
    page.wait_for_timeout(700)
    assert answer.status == 200
    assert outside == [] and errors == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert cut_off(page) == []
    if folder := os.environ.get("SPRUNG_SHOTS"):
        page.screenshot(path=Path(folder) / f"{name}-{width}-{scheme}.png")
    context.close()


def cut_off(page: Any) -> list[str]:
    """Cards and tables that hold more than they show, so that one has to scroll inside them."""
    shown = "[...document.querySelectorAll('.card, table')].filter(e => e.offsetParent)"
    wider = f"{shown}.filter(e => e.scrollWidth > e.clientWidth + 1)"
    return list(
        page.evaluate(f"{wider}.map(e => `${{e.id || e.className}}: ${{e.scrollWidth}} in ${{e.clientWidth}}`)")
    )


@pytest.mark.parametrize("width", [1400, 380])
@pytest.mark.parametrize("label", ["W" * 60, "a name of many short words " * 4])
def test_a_long_name_hides_nothing_of_the_fleet(served: tuple[str, Core], browser: Any, label: str, width: int) -> None:
    address, core = served
    core.operations.rename("test", "car-18", label)
    with core.store.write() as connection:  # nothing has come for long: the longest that a row can say
        connection.execute(fleet_status.update().values(received_ns=START))
    page = browser.new_page(viewport={"width": width, "height": 900})
    for name in ("fleet", "alarms"):
        page.goto(address + PAGES[name])
        assert cut_off(page) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.goto(address)
    badge = page.locator("tr", has_text=label.strip()).locator(".badge").bounding_box()
    assert badge["x"] >= 0 and badge["x"] + badge["width"] <= width
    assert "silent since 2026-" in page.inner_text("table")
    kept(page, f"longname-{width}-{len(label)}")
    core.operations.rename("test", "car-18", None)
    with core.store.write() as connection:  # as before, for the pictures that follow
        connection.execute(fleet_status.update().values(received_ns=now_ns()))
    page.close()


def test_the_drawing_is_whole_and_readable_on_a_phone(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 375, "height": 900})
    page.goto(address + PAGES["vehicle"])
    drawn = "e => parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().a"
    sizes = page.evaluate(
        f"[...document.querySelectorAll('#drawing svg text')].filter(e => e.getBBox().width).map({drawn})"
    )
    assert len(sizes) > 30 and min(sizes) > 10
    boxes = "[...document.querySelectorAll('#drawing svg text:not(.caption)')].map(e => e.getBoundingClientRect())"
    labels = page.evaluate(f"{boxes}.map(b => [b.left, b.right, b.top, b.height])")
    assert len(labels) > 30
    for left, right, _, height in labels:
        assert left >= 0 and right <= 375 and height >= 8
    for kind in (".name", ".sensorname", ".said"):
        found = page.evaluate(
            f"{boxes.replace('text:not(.caption)', kind)}.map(b => [b.left, b.right, b.top, b.bottom])"
        )
        across = [(a, b) for a in found for b in found if a is not b and abs(a[2] - b[2]) < 1]
        assert across and all(a[1] <= b[0] or b[1] <= a[0] for a, b in across), kind
    kept(page, "phone-drawing")
    page.close()


def test_where_a_vehicle_stood_no_line_is_drawn(served: tuple[str, Core], browser: Any, system: System) -> None:
    address, core = served
    levels = [*[0.0] * 90, *[STANDING] * 60, *[0.02] * 60]
    core.pipeline.process("car-21", [make_window(system, i, level) for i, level in enumerate(levels)])
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(address + PAGES["vehicle"])
    page.locator("#shown", has_text="points").wait_for()
    assert not page.locator("#stood").is_visible()
    page.goto(f"{address}/pages/vehicles/car-21")
    page.locator("#shown", has_text="points").wait_for()
    assert "standing" in page.inner_text("#stood")
    pixels = """() => { const c = document.querySelector('#plot canvas'), x = c.getContext('2d');
        const o = document.querySelector('#plot .u-over').getBoundingClientRect(), b = c.getBoundingClientRect();
        const ratio = c.width / b.width, at = (share) => [...x.getImageData(
            ratio * (o.left - b.left + share * o.width), ratio * (o.top - b.top), 1, ratio * o.height).data];
        const wanted = getComputedStyle(document.documentElement).getPropertyValue('--blue').trim();
        const rgb = [1, 3, 5].map((i) => parseInt(wanted.slice(i, i + 2), 16));
        const drawn = (share) => { const d = at(share); let n = 0;
            for (let i = 0; i < d.length; i += 4) n += rgb.every((v, k) => Math.abs(v - d[i + k]) < 40); return n; };
        return [0.3, 0.57, 0.85].map(drawn); }"""
    before, stood, after = page.evaluate(pixels)
    assert before > 0 and after > 0 and stood == 0
    kept(page, "standing")
    page.close()
    core.operations.remove("test", "car-21")


def test_rides_of_seconds_are_seen_in_a_history_of_days(served: tuple[str, Core], browser: Any, system: System) -> None:
    address, core = served
    for begin in (0, 691_200):  # windows, half a second each: four days
        core.pipeline.process("car-22", [make_window(system, begin + i) for i in range(80)])
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.add_init_script(NOTED)
    page.goto(f"{address}/pages/vehicles/car-22")
    page.locator("#shown", has_text="160 points").wait_for()
    page.wait_for_timeout(500)
    blue = """() => { const c = document.querySelector('#plot canvas'), o = document.querySelector('#plot .u-over');
        const p = o.getBoundingClientRect(), b = c.getBoundingClientRect(), ratio = c.width / b.width;
        const wanted = getComputedStyle(document.documentElement).getPropertyValue('--blue').trim();
        const rgb = [1, 3, 5].map((i) => parseInt(wanted.slice(i, i + 2), 16));
        return [0, 1].map((share) => { const d = c.getContext('2d').getImageData(
            ratio * (p.left - b.left + share * p.width - 5), ratio * (p.top - b.top), 10 * ratio, ratio * p.height);
            let n = 0;
            for (let i = 0; i < d.data.length; i += 4) n += rgb.every((v, k) => Math.abs(v - d.data[i + k]) < 40);
            return n; }); }"""
    assert min(page.evaluate(blue)) > 12
    assert "%" in page.evaluate("window.written")
    kept(page, "rides")
    page.close()
    core.operations.remove("test", "car-22")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_description_of_the_api_is_dark_where_all_is(address: str, browser: Any, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 1400, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    outside: list[str] = []
    page.on("request", lambda asked: None if asked.url.startswith((address, "data:")) else outside.append(asked.url))
    page.goto(address + "/docs")
    page.locator(".opblock").first.wait_for()
    brightness = "(e => getComputedStyle(e).%s.match(/[\\d.]+/g).slice(0, 3).reduce((a, b) => a + +b, 0) / 3)"
    for place in (".swagger", ".swagger .swagger-ui"):
        ground = page.evaluate(f"{brightness % 'backgroundColor'}(document.querySelector('{place}'))")
        if scheme == "dark":
            assert ground < 60, place
    ink = page.evaluate(f"{brightness % 'color'}(document.querySelector('.opblock-summary-description'))")
    assert (ink > 130) == (scheme == "dark") and outside == []
    kept(page, f"docs-{scheme}")
    context.close()


def test_load_and_temperature_are_drawn_below_the_history(address: str, browser: Any) -> None:
    page = browser.new_page()
    page.goto(address + PAGES["vehicle"])
    page.wait_for_timeout(1500)
    assert page.locator("#ran canvas").count() == 1
    told = page.inner_text("#ran")
    assert "car.load" in told and "temperature" in told
    page.goto(address + "/pages/vehicles/car-18")
    page.wait_for_timeout(1500)
    assert not page.locator("#ran").is_visible()
    page.close()


def test_a_history_is_laid_beside_its_twins_and_zoomed_down_to_single_windows(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(address + PAGES["vehicle"])

    def shown() -> str:
        page.wait_for_timeout(900)
        return str(page.inner_text("#shown"))

    def drawn() -> list[str]:
        legend = page.locator("#plot .u-legend .u-label").all_inner_texts()
        return [name for name in legend if name not in ("time", "upper", "lower")]

    assert shown() == "140 points, single windows"
    page.locator("#drawing a[data-element='secondary_2l']").first.click()
    shown()
    assert page.input_value("#parameter") in drawn() and page.input_value("#parameter").startswith("secondary_2l.")
    page.select_option("#parameter", "secondary_1l.damping")
    for overlay, beside in (("side", "secondary_1r.damping"), ("end", "secondary_2l.damping")):
        page.select_option("#overlay", overlay)
        shown()
        assert drawn() == ["secondary_1l.damping", beside]
    page.get_by_role("button", name="1 min").click()
    assert int(shown().split()[0]) in (119, 120)
    page.get_by_role("button", name="zoom in").click()
    assert int(shown().split()[0]) in (59, 60, 61)
    page.get_by_role("button", name="earlier").click()
    assert int(shown().split()[0]) in (59, 60, 61)
    box = page.locator("#plot .u-over").bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 60, steps=5)
    page.mouse.up()
    assert int(shown().split()[0]) in (14, 15, 16)
    page.locator("#plot .u-over").dblclick()
    assert shown() == "140 points, single windows"
    page.close()


def shown(page: Any) -> str:
    """What is said of the history, once it is drawn."""
    page.wait_for_timeout(900)
    return str(page.inner_text("#shown"))


def test_what_is_shown_of_a_history_stays_over_reloads_links_and_the_way_back(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(address + PAGES["vehicle"])
    begun = page.input_value("#parameter")
    page.select_option("#parameter", "secondary_1l.damping")
    page.select_option("#overlay", "side")
    page.get_by_role("button", name="10 min").click()
    page.get_by_role("button", name="zoom in").click()
    told = shown(page)
    page.reload()
    assert shown(page) == told
    assert [page.input_value(box) for box in ("#parameter", "#overlay")] == ["secondary_1l.damping", "side"]
    other = browser.new_page(viewport={"width": 1400, "height": 900})
    other.goto(page.url)
    assert shown(other) == told and other.input_value("#parameter") == "secondary_1l.damping"
    other.evaluate("location.hash = 'primary_12r.damping'")
    shown(other)
    assert other.input_value("#parameter") == "primary_12r.damping"
    other.goto(address)
    other.goto(f"{address}{PAGES['vehicle']}#%zz&since=never")  # nobody's link
    assert "points" in shown(other) and other.input_value("#parameter") == begun
    other.close()
    page.go_back()
    shown(page)
    assert page.input_value("#parameter") == begun and "points" in shown(page)
    page.close()


def test_ranges_without_a_window_and_the_narrowest_are_told(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    wrong: list[str] = []
    page.on("response", lambda answer: wrong.append(answer.url) if answer.status >= 400 else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(address + PAGES["vehicle"])
    shown(page)
    for _ in range(30):
        page.get_by_role("button", name="zoom in").click()
    assert shown(page) == "2 points, single windows"
    for _ in range(60):
        page.get_by_role("button", name="zoom out").click()
    assert shown(page).startswith("140 points")
    page.get_by_role("button", name="1 min").click()
    for _ in range(10):
        page.get_by_role("button", name="later").click()
    assert shown(page) == "no window in this range: “all” shows every one"
    page.get_by_role("button", name="all", exact=True).click()
    assert shown(page).startswith("140 points") and wrong == []
    page.close()


def test_a_range_up_to_the_newest_window_follows_it(served: tuple[str, Core], browser: Any, system: System) -> None:
    address, core = served
    core.pipeline.process("car-23", [make_window(system, i) for i in range(300)])
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(f"{address}/pages/vehicles/car-23")
    page.get_by_role("button", name="1 min").click()
    shown(page)
    page.wait_for_timeout(1000)
    core.pipeline.process("car-23", [make_window(system, i) for i in range(300, 420)])  # another minute
    page.locator("#status", has_text="last change").wait_for()
    shown(page)
    page.get_by_text("The newest points as a table").click()
    newest = page.locator("#table tr").last.inner_text()
    with core.store.read() as connection:
        row = fleet_row(connection, "car-23")
    assert row is not None and row.last_window_ns is not None
    assert newest.startswith(to_iso(row.last_window_ns)[:19].replace("T", " "))
    page.close()
    core.operations.remove("test", "car-23")


def test_who_picks_parameters_after_a_repair_has_these_learned_anew(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(address + PAGES["vehicle"])
    page.get_by_role("button", name="Mark maintenance").click()
    page.fill("#worktext", "damper exchanged")
    page.select_option("select[name=parameters]", "secondary_2r.damping")
    assert page.get_by_label("of these").is_checked()
    page.select_option("select[name=parameters]", [])
    page.locator("dialog[open] button.first").click()
    page.locator("dialog[open] [role=alert]", has_text="Choose at least one parameter").wait_for()
    page.close()


# notes where times are written on canvases: from the top, from the left, to
NOTED = """(() => { const real = CanvasRenderingContext2D.prototype.fillText; window.labels = []; window.written = [];
    CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        const at = this.getTransform(), width = this.measureText(text).width;
        const left = at.e + x - (this.textAlign === "center" ? width / 2 : 0);
        window.written.push(text);
        if (/[0-9]:|-[0-9]/.test(text)) window.labels.push([Math.round(at.f + y), left, left + width]);
        real.call(this, text, x, y); }; })()"""


@pytest.mark.parametrize("width", [1400, 380])
def test_times_along_the_history_do_not_overlap(address: str, browser: Any, width: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.add_init_script(NOTED)
    page.goto(address + PAGES["vehicle"])
    page.wait_for_timeout(900)
    for name in ("1 min", "10 min", "1 h", "1 d", "7 d", "30 d"):
        page.evaluate("window.labels = []")
        page.get_by_role("button", name=name, exact=True).click()
        page.wait_for_timeout(900)
        drawn = {tuple(label) for label in page.evaluate("window.labels")}
        for row in {top for top, *_ in drawn}:
            across = sorted((left, right) for top, left, right in drawn if top == row)
            assert all(a[1] < b[0] for a, b in pairwise(across)), (name, across)
    page.close()


def test_the_fleet_is_searched_filtered_and_followed(served: tuple[str, Core], browser: Any, system: System) -> None:
    """What happens shows without a reload."""
    address, core = served
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(address)
    listed = "tbody tr td.head a"
    assert page.locator(listed).first.inner_text() == "car-17"
    assert page.locator("tbody tr svg").count() == page.locator("tbody tr").count()
    page.fill("#q", "car-18")
    page.keyboard.press("Enter")
    page.wait_for_url("**q=car-18**")
    assert page.locator(listed).all_inner_texts() == ["car-18"]
    page.goto(address)
    page.locator("p.counts a.out_of_specification").click()
    page.wait_for_url("**health=out_of_specification**")
    assert page.locator(listed).all_inner_texts() == ["car-17"]
    page.goto(address)
    page.wait_for_timeout(500)
    core.pipeline.process("car-99", [make_window(system, i) for i in range(3)])
    page.locator("#v-car-99").wait_for(timeout=10_000)
    page.close()
    core.operations.remove("test", "car-99")


def test_the_first_load_of_a_vehicle_is_light(address: str, browser: Any) -> None:
    page = browser.new_page()
    page.goto(address + PAGES["vehicle"])
    page.wait_for_timeout(1000)
    entries = "[...performance.getEntriesByType('resource'), ...performance.getEntriesByType('navigation')]"
    assert 20_000 < page.evaluate(f"{entries}.reduce((sum, one) => sum + one.encodedBodySize, 0)") <= MOST_BYTES
    page.close()


@pytest.mark.parametrize("name", PAGES)
@pytest.mark.parametrize("width", [1400, 380])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(address: str, browser: Any, name: str, width: int, scheme: str) -> None:
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.goto(address + PAGES[name])
    page.wait_for_timeout(700)
    assert serious(page) == []
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious_in_the_description_of_the_api(address: str, browser: Any, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 1400, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.goto(address + "/docs")
    page.locator(".opblock").first.wait_for()
    page.locator(".opblock-summary-control").first.click()
    page.locator(".opblock-body").first.wait_for()
    page.wait_for_timeout(500)
    assert page.locator("main").count() == 1
    names = page.evaluate("[...document.querySelectorAll('button.expand-operation')].map(e => e.ariaLabel)")
    assert len(set(names)) == len(names) > 3 and all(name.startswith("Operations of ") for name in names)
    assert serious(page) == [] and page.locator("h1.title").get_attribute("aria-level") == "2"
    context.close()


def serious(page: Any) -> list[tuple[str, str]]:
    """What axe-core calls serious or worse: the rule, and where."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    found = axe.Axe().run(page).response["violations"]
    return [(one["id"], one["nodes"][0]["html"][:200]) for one in found if one["impact"] in ("serious", "critical")]


def test_every_control_of_the_vehicle_page_is_reached_by_keys_and_seen(address: str, browser: Any) -> None:
    page = browser.new_page()
    page.goto(address + PAGES["vehicle"])
    page.wait_for_timeout(700)
    wanted = page.evaluate(
        "[...document.querySelectorAll('button, select, input, a[href]')].filter(e => e.offsetParent).length"
    )
    reached = set()
    for _ in range(3 * wanted):
        page.keyboard.press("Tab")
        where = page.evaluate(
            "(e => [e.tagName, e.id, e.textContent.slice(0, 30), getComputedStyle(e).outlineStyle,"
            " e.getBoundingClientRect().top + scrollY].join('|'))(document.activeElement)"
        )
        if where in reached:
            break
        reached.add(where)
    assert len(reached) >= 0.9 * wanted, (len(reached), wanted)
    unseen = [one for one in reached if one.split("|")[3] == "none" and not one.startswith("BODY")]
    assert unseen == []
    page.close()


def test_an_alarm_is_acknowledged_by_keys(address: str, browser: Any) -> None:
    page = browser.new_page()
    page.goto(address + PAGES["vehicle"])
    button = page.get_by_role("button", name="Acknowledge").first
    button.focus()
    page.keyboard.press("Enter")
    page.wait_for_timeout(1500)
    if page.locator("dialog[open]").count():
        page.keyboard.press("Enter")
        page.wait_for_timeout(1500)
    page.goto(address + PAGES["vehicle"])
    assert "acknowledged" in page.inner_text("main")
    page.close()


@pytest.fixture(scope="module")
def report_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    return write_report(friction_report(), load_system(), folder).page


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 380])
def test_a_report_is_read_on_a_phone_and_in_the_dark(report_page: Path, browser: Any, width: int, scheme: str) -> None:
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.goto(report_page.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    red = page.evaluate("Number(getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0])")
    assert (red < 100) == (scheme == "dark")
    sizes = page.evaluate(
        "[...document.querySelectorAll('.picture')].map(p => [p.scrollWidth - p.clientWidth, !!p.closest('.drawing'),"
        " p.querySelector('img').clientWidth / p.querySelector('img').naturalWidth])"
    )
    for beyond, drawing, shrunk in sizes:  # letters are drawn 16 pixels high
        assert beyond <= 0 and (drawing or shrunk > 0.5)
    assert serious(page) == []
    kept(page, f"report-{width}-{scheme}")
    context.close()


def test_findings_with_long_names_fit_a_screen(tmp_path: Path, browser: Any) -> None:
    """Without it the last column, by how much the runner-up is behind, was beyond the edge."""
    made = friction_report()
    drift = LawParameter("p", -0.445, 0.008, "1"), LawParameter("tau", 231.0, 17.0, "s")
    runner_up = {"runner_up": ("time_varying_stiffness", -2162.0), "runner_up_location": "primary_12r"}
    found = replace(made.findings[0], effect="time_varying_damping", parameters=drift, **runner_up)  # type: ignore[arg-type]
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(write_report(replace(made, findings=(found,)), load_system(), tmp_path).page.as_uri())
    assert page.evaluate("[...document.querySelectorAll('.scroll')].map(s => s.scrollWidth - s.clientWidth)[0]") <= 0
    page.close()


LAW = "laws: [{coulomb_friction: {force: {value: 300, std: 1}, smoothing: {value: 0.02, fixed: true}}}]"
SPRING = "stiffness: 4.3e+5, damping: 2.0e+4}"  # of the secondary suspension


def friction_found(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis that takes no time and knows the answer: dry friction in one of the secondary dampers."""
    request.out.mkdir(parents=True)
    (request.out / "report.html").write_text("<!doctype html><!-- back --><h1>dry friction</h1>")
    (request.out / "system.yaml").write_text(MANCHESTER.read_text().replace(SPRING, f"{SPRING[:-1]}, {LAW}}}", 1))
    return DiagnosisResult("missing_physics", REPORT)


def test_an_upload_is_followed_to_its_report_and_what_was_found_is_put_to_use(
    served: tuple[str, Core], browser: Any, tmp_path: Path
) -> None:
    address, core = served
    core.diagnosis_jobs.task = friction_found
    (tmp_path / "ride.csv").write_text("time,car_1l\n" + "1790000000.0,0.0\n" * 100_000)
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(f"{address}/pages/work")
    page.set_input_files("#file", tmp_path / "ride.csv")
    page.fill("#vehicle", "car-18")
    page.fill("#start", "2026-09-21T14:13:20")
    page.select_option("#what", "/diagnose")
    page.get_by_role("button", name="Upload").click()
    page.locator("progress#sent").wait_for()
    page.locator("#outcome:has-text('diagnosis')").wait_for()
    page.locator("#jobs:has-text('diagnosis')").wait_for()  # listed as soon as it is taken
    kept(page, "upload")
    with core.store.read() as connection:
        row = work.get_recording(connection, str(list_jobs(connection, 1)[0].recording_id))
    assert row is not None and row.began_ns == 1_790_000_000 * 10**9
    page.wait_for_selector("a:has-text('report: missing physics')", timeout=180_000)  # the page has come anew
    page.click("a:has-text('report: missing physics')")
    assert page.inner_text("h1") == "dry friction"
    page.get_by_role("link", name="use").click()

    dialog = page.locator("dialog#usemodel[open]")
    dialog.wait_for()
    assert "Use this model for car-18" in dialog.inner_text()
    kept(page, "use-this-model", whole=False)
    page.keyboard.press("Escape")  # thought better of it
    assert core.pipeline.state("car-18").used and page.locator("dialog[open]").count() == 0
    page.get_by_role("button", name="Use this model").first.click()
    page.keyboard.press("Enter")
    page.wait_for_selector("#models:has-text('coulomb_friction')", timeout=60_000)
    assert "the vehicle's own" in page.inner_text("main").replace("’", "'")
    page.close()


def endless(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis that ends only when it is cancelled."""
    time.sleep(600)
    raise AssertionError


def test_a_job_is_cancelled_and_an_upload_stopped_in_the_page(
    served: tuple[str, Core], browser: Any, tmp_path: Path
) -> None:
    address, core = served
    core.diagnosis_jobs.task = endless
    (tmp_path / "ride.csv").write_text("time,car_1l\n" + "1790000000.0,0.0\n" * 1000)
    (tmp_path / "long.csv").write_text("time,car_1l\n" + "1790000000.0,0.0\n" * 2_000_000)
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(f"{address}/pages/work")
    page.set_input_files("#file", tmp_path / "ride.csv")
    page.fill("#vehicle", "car-18")
    page.select_option("#what", "/diagnose")
    page.get_by_role("button", name="Upload").click()
    page.get_by_role("button", name="Cancel diagnosis of car-18").click(timeout=60_000)
    page.locator("#jobs:has-text('cancelled')").wait_for(timeout=60_000)
    assert page.get_by_role("button", name="Cancel diagnosis of car-18").count() == 0
    slow = page.context.new_cdp_session(page)
    slow.send("Network.enable")
    conditions = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 500_000}
    slow.send("Network.emulateNetworkConditions", conditions)
    page.set_input_files("#file", tmp_path / "long.csv")
    page.get_by_role("button", name="Upload").click()
    page.get_by_role("button", name="Stop sending").click()
    page.locator("#outcome", has_text="stopped").wait_for()
    page.close()
    while list(core.settings.uploads.glob("*.part*")):  # what had come is removed
        time.sleep(0.1)


def test_people_sign_in_with_their_organisation(engine: Engine, browser: Any, data_dir: Path) -> None:
    with running_provider() as provider:
        core = build_core(provider_settings(provider, data_dir), engine)
        with serving(core) as address:
            page = browser.new_page(viewport={"width": 1400, "height": 900})
            page.goto(f"{address}/pages/work")
            assert "/signin" in page.url
            kept(page, "signin-organisation")
            page.get_by_role("link", name="Sign in with your organisation").click()
            page.wait_for_url(f"{address}/pages/work")
            assert page.inner_text("h1") == "Work"
            assert "anna" in (page.get_by_role("button", name="Sign out").get_attribute("title") or "")
            page.close()


def kept(page: Any, name: str, whole: bool = True) -> None:
    """Keep a picture for the documents: of the whole page, or of what a person sees at once (a dialog)."""
    if folder := os.environ.get("SPRUNG_SHOTS"):
        page.wait_for_timeout(900)
        page.screenshot(path=Path(folder) / f"{name}.png", full_page=whole)
