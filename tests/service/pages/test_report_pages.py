"""The mismatch report for people: offline, complete, true to the report's numbers."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sprung.model.diagnosis.report.report import (
    LawParameter,
)
from sprung.model.system import load_system, parse_system
from sprung.service.report import words
from sprung.service.report.drawing import draw_system
from sprung.service.report.layout import lay_out
from sprung.service.report.values import largest_bias
from sprung.service.report.writing import findings_by_place, write_report
from tests.report_made import SYSTEM, friction_report


def test_the_page_needs_nothing_from_outside_and_holds_every_picture(tmp_path: Path) -> None:
    files = write_report(friction_report(), SYSTEM, tmp_path / "new" / "folder")
    page = files.page.read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|srcset|href)=["'](?!data:)""", page)
    assert "http" not in page
    assert page.count(' src="data:image/png;base64,') == len(files.pictures)
    narrow = {"fit", "parameters", "force_0", "residual_0"}  # those of panels beside each other
    assert page.count(' srcset="data:image/png;base64,') == len(narrow) and narrow < set(files.pictures)
    assert {path.name for path in files.page.parent.iterdir()} == {
        *(path.name for path in files.pictures.values()),
        files.page.name,
        files.data.name,
    }
    expected = {"system", "fit", "sensors", "locations", "parameters", "force_0", "residual_0"}
    assert set(files.pictures) == expected
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files.pictures.values())


def test_the_sentence_says_place_law_share_and_the_bias_it_had_caused() -> None:
    sentence = words.headline(friction_report())
    assert sentence == (
        "secondary_1r: dry friction of 395 ± 6 N; explains 99 % of the excess error; "
        "without it the damping was read 148 % too high."
    )


def test_the_largest_bias_is_none_where_nothing_moved() -> None:
    report = friction_report()
    assert largest_bias(replace(report, baseline=report.augmented)) is None


def test_the_json_beside_the_page_is_the_reports_own(tmp_path: Path) -> None:
    report = friction_report()
    files = write_report(report, SYSTEM, tmp_path)
    assert json.loads(files.data.read_text(encoding="utf-8")) == json.loads(json.dumps(report.to_dict()))


def test_a_consistent_report_without_arrays_still_makes_a_page(tmp_path: Path) -> None:
    report = replace(
        friction_report(),
        verdict="consistent",
        findings=(),
        plot_data={},
        candidates=(),
        explained=None,
        advice=("the record is too short to see <slow> changes",),
    )
    files = write_report(report, SYSTEM, tmp_path)
    page = files.page.read_text(encoding="utf-8")
    assert "Nothing is missing" in page
    assert "&lt;slow&gt;" in page
    assert "fit" not in files.pictures


def test_an_unknown_law_is_shown_as_a_force_map(tmp_path: Path) -> None:
    report = friction_report()
    d, v = np.linspace(-1e-3, 1e-3, 9), np.linspace(-0.05, 0.05, 7)
    force = np.outer(v, d**2) * 4e9
    finding = replace(report.findings[0], effect="unknown", parameters=())
    evidence = {
        "finding.0.map_d": d,
        "finding.0.map_v": v,
        "finding.0.map_force": force,
        "finding.0.map_std": 0 * force + 5,
    }
    report = replace(report, verdict="unknown_physics", findings=(finding,), plot_data=evidence)
    assert "force_0" in write_report(report, SYSTEM, tmp_path).pictures


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (395.2, 6.1, "N", "395 ± 6 N"),
        (0.002134, 0.00031, "m/s", "2.1 ± 0.3 mm/s"),
        (7.7994e9, 2.1e7, "N/m^3", "(7.799 ± 0.021)e9 N/m^3"),
        (0.8690, 0.0014, "-", "0.8690 ± 0.0014"),
        (12.0, float("nan"), "Hz", "12 Hz"),
    ],
)
def test_quantities_are_rounded_to_their_uncertainty(value: float, std: float, unit: str, text: str) -> None:
    assert words.quantity(LawParameter("p", value, std, unit)) == text


def test_the_drawing_stacks_the_car_on_the_bogies_on_the_wheels() -> None:
    level = lay_out(SYSTEM).level
    assert level["car"] == 2
    assert level["bogie1"] == level["bogie2"] == 1


def test_the_drawing_of_a_narrow_rig_is_no_wider_than_it_needs_to_be() -> None:
    rig = load_system(Path(__file__).parents[3] / "benchmarks/systems/quarter_car.yaml")
    plain, found = (draw_system(rig, {name: "some words" for name in names}, {}) for names in ([], ["strut"]))
    width, height = plain.get_size_inches()
    assert width < 0.7 * height  # half of a phone's screen, not the middle of a page that is wider than it
    assert width < found.get_size_inches()[0] < draw_system(SYSTEM, {}, {}).get_size_inches()[0]


def test_a_component_on_a_test_bench_hangs_from_what_moves_it() -> None:
    rig = parse_system(
        """
name: bench
sample_rate: 200
window: 200
bodies: {}
inputs:
  rod: {kind: support, displacement: {column: Weg, noise: 2.0e-6}}
elements:
  damper: {upper: rod, lower: ground, stiffness: 1.0e+3, damping: 1.5e+3}
sensors:
  cell: {kind: force, element: damper, column: Kraft, noise: 2.0}
"""
    )
    layout = lay_out(rig)
    assert layout.bottom("rod") == layout.top("rod") > layout.top("ground") == 0.0
    (axes,) = draw_system(rig, {"damper": "dry friction of 90 N; static preload of 117 N"}, {}).axes
    heights = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    drawn = np.concatenate([line for line in heights if len(line) == 13])  # the spring's
    assert drawn.min() == 0.0 and drawn.max() == layout.bottom("rod")
    assert "dry friction of 90 N" in axes.texts[-1].get_text() and "preload" in axes.texts[-1].get_text()


def test_all_findings_of_a_place_share_its_label() -> None:
    found = friction_report().findings[0]
    other = replace(found, effect="preload", parameters=(LawParameter("force", 117.0, 0.2, "N"),))
    words_at = findings_by_place([found, other], SYSTEM.catalogue)
    assert list(words_at) == [found.location]
    assert "friction" in words_at[found.location] and "preload of 117.00 ± 0.20 N" in words_at[found.location]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (186.5, 2, "190"),
        (0.23, 2, "0.23"),
        (2410.04, 4, "2.41 k"),
        (999.9e3, 2, "1 M"),
        (0.0, 4, "0"),
        (3e-3, 2, "3 m"),
    ],
)
def test_numbers_of_tables_have_no_exponents(value: float, digits: int, text: str) -> None:
    assert words.number(value, digits) == text


@pytest.mark.parametrize(
    "place", ["secondary_1r", "car", "bogie1_2r", "wheel_21l.velocity", "wheel_21l|wheel_21r", "nowhere"]
)
def test_the_drawing_calls_out_what_was_located_wherever_it_is(place: str) -> None:
    figure = draw_system(SYSTEM, {place: "some words"}, {})
    said = any("some words" in text.get_text() for text in figure.axes[0].texts)
    assert said == (place != "nowhere")


def test_a_fault_that_all_sensors_share_has_room_in_the_drawing() -> None:
    """Twelve names in a row are wider than the vehicle, which then had to be drawn smaller."""
    figure = draw_system(SYSTEM, {"|".join(SYSTEM.sensors): "some words"}, {})
    (said,) = [text.get_text() for text in figure.axes[0].texts if "some words" in text.get_text()]
    assert said == "car_1l, car_1r, car_2l and 9 more\nsome words"
