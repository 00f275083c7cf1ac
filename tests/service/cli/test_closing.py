"""What a replay says last of measurements and loads."""

from sprung.service.cli.replay import measurement_lines
from sprung.service.monitoring.words import size_in_words


def test_the_size_of_a_change_is_said_in_its_own_unit() -> None:
    assert size_in_words("secondary_2r.damping", -0.2957, 0.0151) == "-29.6 ± 1.5 %"
    assert size_in_words("bogie1_1l.delay", 0.00398, 0.00012) == "+4.0 ± 0.1 ms"
    assert size_in_words("bogie1_1l.gain", 0.059) == "+5.9 %"
    assert size_in_words(None, None) == ""


def test_a_level_is_no_change_and_has_its_unit() -> None:
    assert size_in_words("wheel_21r.displacement.frozen", 0.00127, 0.0) == ""
    assert size_in_words("car_1l|car_1r.swapped", 0.0, 0.0) == "" == size_in_words("car_1l.noisy", 0.4, 0.1)
    units = {"wheel_21r.displacement": "m", "car_1l": "m/s^2"}
    found = [
        {"channel": "wheel_21r.displacement", "kind": "frozen", "value": 0.001271, "std": 0.0},
        {"channel": "car_1l", "kind": "noisy", "value": 0.41, "std": 0.1},
        {"channel": "bogie1_1l|bogie1_1r", "kind": "delay", "value": 0.003872, "std": 8.8e-5},
        {"channel": "car_1l", "kind": "inverted", "value": -1.0, "std": 0.0},
    ]
    assert measurement_lines({"sensors": found}, units) == [
        "sensor: wheel_21r.displacement frozen at 0.001271 m",
        "sensor: car_1l noisy, 0.41 m/s^2",
        "sensor: bogie1_1l|bogie1_1r delay 3.872 ± 0.088 ms",
        "sensor: car_1l inverted",
    ]


def test_wrong_sensors_and_loads_are_reported_below_the_table() -> None:
    found = {
        "sensors": [
            {"channel": "bogie1_1l", "kind": "gain", "value": 1.0507, "std": 0.0034},
            {"channel": "car_1l", "kind": "stuck", "value": None, "std": None},
        ],
        "load": {"car": [-4038.3, 360.9]},
        "built": [{"body": "bogie1", "what": "pitch inertia over mass", "change": -0.0312, "std": 0.004}],
    }
    assert measurement_lines(found, {}) == [
        "sensor: bogie1_1l gain 1.051 ± 0.0034",
        "sensor: car_1l stuck",
        "system file: bogie1 is -3.1 % ± 0.4 % in pitch inertia over mass",
        "load: car -4038 ± 361 kg against nominal",
    ]
    assert measurement_lines({"sensors": [], "load": {}}, {}) == []


def test_a_load_from_before_a_stop_says_so() -> None:
    found = {"sensors": [], "load": {"car": [-4038.3, 360.9]}, "load_as_of": "2026-11-23T10:03:12Z"}
    (line,) = measurement_lines(found, {})
    assert line == "load: car -4038 ± 361 kg against nominal, as of 2026-11-23T10:03:12Z; not observable since"
