"""What a vehicle's page says of its sensors, and of alarms whose cause the evidence leaves open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.identifier import without_values
from sprung.model.signals import BuiltOtherwise, MeasurementFault, Window
from sprung.model.system import load_system
from sprung.model.tracking.state import Alarm
from sprung.service.monitoring.processed import NO_EXCITATION, outcome_of
from sprung.service.monitoring.views import ParameterView, VehicleView, suspected
from sprung.service.pages.vehicle import sensor_marks
from sprung.service.rendering.drawing import Mark
from sprung.service.rendering.states import hints
from sprung.service.store.fleet import AlarmRow
from sprung.service.store.status import FleetRow, without_numbers

SYSTEM = load_system()
GAIN = Alarm("sensor", "bogie1_1l.gain", 0, 1, "warning", 0.05, 0.003)
LATE = Alarm("sensor", "car_1l|car_1r.delay", 0, 1, "warning", 0.002, 0.0001)
INPUT = Alarm("sensor", "wheel_11l.displacement.gain", 0, 1, "warning", 0.05, 0.003)
DAMPER = Alarm("change", "primary_11l.damping", 0, 1, "warning", -0.1, 0.02, alternatives=("bogie1_1l.gain",))
WINDOWS = dict.fromkeys(("used", "repaired", "dropped", "uninformative", "unfitting"), 0)
ROW = FleetRow(
    "v", None, None, "check_function", 1, 0, 1, 1, 0, None, None, None, None, 1.0, "", 1, 1, WINDOWS | {"used": 9}
)  # fmt: skip
VIEW = VehicleView("v", "m", "check_function", (), (GAIN, LATE, INPUT), None, 1, dict.fromkeys(SYSTEM.sensors, 0.1))


def test_channels_and_fault_of_a_sensor_alarm() -> None:
    assert suspected(GAIN) == (("bogie1_1l",), "gain")
    assert suspected(LATE) == (("car_1l", "car_1r"), "delay")
    assert suspected(INPUT) == (("wheel_11l.displacement",), "gain")


def test_every_channel_that_an_alarm_names_is_suspect_and_no_other() -> None:
    marks = sensor_marks(SYSTEM, VIEW)
    suspects = {name for name, mark in marks.items() if mark.state == "suspect"}
    assert suspects == {"bogie1_1l", "car_1l", "car_1r", "wheel_11l.displacement"}
    assert set(SYSTEM.sensors) <= marks.keys() and marks["car_2l"] == Mark("ok")


def test_a_closed_alarm_accuses_nobody() -> None:
    closed = replace(VIEW, alarms=(replace(GAIN, closed=2),))
    assert all(mark.state == "ok" for mark in sensor_marks(SYSTEM, closed).values())


def test_what_an_alarm_cannot_be_distinguished_from_is_reported() -> None:
    view = replace(VIEW, alarms=(DAMPER,))
    rivals = DAMPER.alternatives
    active = [AlarmRow("change", DAMPER.parameter, 0, 1, None, "warning", -0.1, 0.02, None, alternatives=rivals)]
    said = hints(ROW, view, active, [], False, sensor_marks(SYSTEM, view))
    assert said[0].title == "bogie1_1l.gain or primary_11l.damping has changed by -10.0 ± 2.0 %"
    assert said[0].text.startswith("Since 1970-01-01 00:00:00 UTC. ")
    assert "do not tell it from bogie1_1l.gain: check the sensor first" in said[0].text
    assert not any("Sensor suspect" in hint.title for hint in said)


def test_what_is_wrong_with_a_sensor_is_said_with_its_size_and_since_when() -> None:
    active = [AlarmRow("sensor", "bogie1_1l.gain", 10**9, 1, None, "warning", 0.059, 0.003, None)]
    said = hints(ROW, VIEW, active, [], False, {"bogie1_1l": Mark("suspect")})
    assert said[0].title == "Sensor suspect: bogie1_1l"
    assert said[0].text.startswith("Since 1970-01-01 00:00:01 UTC: bogie1_1l, gain +5.9 ± 0.3 %. Check mounting")


def test_a_body_that_is_not_as_its_file_says_is_reported() -> None:
    view = replace(VIEW, alarms=(), built=(BuiltOtherwise("bogie1", "mass", 0.024, 0.006),))
    (said,) = hints(ROW, view, [], [], False, sensor_marks(SYSTEM, view))
    assert said.level == "info"
    assert "bogie1 +2.4 % ± 0.6 % in mass" in said.text


def test_an_element_is_said_to_be_unidentifiable_because_of_a_lost_input() -> None:
    channels = "wheel_11r.displacement|wheel_11r.velocity"
    spring = ParameterView(
        "primary_11r.stiffness", "primary_11r", "stiffness", "N/m", 1.0, 1.0, 0.1, False, 1.0, 0.0, 0.1, None, channels
    )
    known = replace(spring, name="primary_11l.stiffness", element="primary_11l", identifiable=True, lost_with=None)
    (said,) = hints(ROW, replace(VIEW, alarms=(), parameters=(spring, known)), [], [], False, {})
    assert said.title == (
        "Not identifiable while wheel_11r.displacement and wheel_11r.velocity are lost: primary_11r.stiffness"
    )
    assert spring.as_dict()["lost_with"] == channels and spring.state == "not_identifiable"
    assert "lost_with" not in known.as_dict()


def test_a_vehicle_without_its_inputs_is_said_not_to_be_monitored_rather_than_to_stand() -> None:
    channels = "wheel_11r.displacement|wheel_11r.velocity|wheel_12l.displacement"
    spring = ParameterView(
        "primary_11r.stiffness", "primary_11r", "stiffness", "N/m", 1.0, 1.0, 0.1, False, 1.0, 0.0, 0.1, None, channels
    )
    row = replace(ROW, windows=WINDOWS | {"used": 2, "uninformative": 90})
    lost = replace(VIEW, alarms=(), parameters=(spring, replace(spring, name="primary_11l.stiffness")))
    (said,) = hints(row, lost, [], [], False, {})
    assert (said.level, said.title) == ("alarm", "Not monitored while wheel_11r.displacement and 2 more are lost")
    (stands,) = hints(row, replace(lost, parameters=()), [], [], False, {})
    assert stands.title == "Uninformative"


def test_a_window_says_that_channels_are_missing_rather_than_that_the_vehicle_stands() -> None:
    window = Window(0, 100.0, np.zeros((2, 3)))
    stands = without_values(2, 3)
    silent = tuple(MeasurementFault(f"wheel_11l.{what}", "silent", 0.0) for what in ("displacement", "velocity"))
    assert outcome_of(window, stands) == ("uninformative", NO_EXCITATION)
    moved = replace(stands, running=True, faults=silent)
    assert outcome_of(window, moved)[1] == "tells nothing without wheel_11l.displacement and 1 more, or at this speed"
    assert outcome_of(window, replace(moved, faults=()))[1] == NO_EXCITATION
    exchanged = replace(moved, faults=(MeasurementFault("car_1l|car_1r", "swapped", 0.0),))
    reason = outcome_of(window, exchanged)[1]
    assert reason == "tells nothing without car_1l and 1 more, or at this speed"
    assert without_numbers(reason) == "tells nothing without car_1l and others, or at this speed"
