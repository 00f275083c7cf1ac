"""What a system file can say about own data, and how everything that is wrong with it is told at once."""

import json
import time
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.schema import SI, SystemFileError
from sprung.model.system import System, load_system, parse_system
from sprung.model.systemfile import json_schema, parse_system_file
from sprung.model.units import FACTORS, ZEROS, UnitError, to_si
from sprung.service.cli import main
from tests.test_system import QUARTER_CAR

RIG = """
name: rig
sample_rate: 200
window: 128
time: {column: Zeit, unit: ms, epoch: 2026-09-21T14:00:00Z}
speed: 40
bodies:
  mass: {mass: 2.0, roll_inertia: 0.1, pitch_inertia: 0.2}
inputs:
  rod: {kind: support, displacement: {column: stroke, unit: mm, noise: 1e-6}}
elements:
  spring: {upper: mass, lower: rod, position: [0.5, 0.0], stiffness: 800.0, damping: 4.0}
  left: {upper: mass, lower: rod, position: [0.0, 0.5], stiffness: 800.0, damping: 4.0}
  right: {upper: mass, lower: rod, position: [0.0, -0.6], stiffness: 700.0, damping: 4.0}
sensors:
  top: {kind: acceleration, body: mass, column: acc, unit: g, noise: 0.01}
  rolls: {kind: roll_rate, body: mass, csv: gyro_x, unit: deg/s, sign: -1, noise: 1e-4}
  pitches: {kind: pitch_rate, body: mass, csv: gyro_y, noise: 1e-4}
  cell: {kind: force, element: spring, column: 3, unit: V, scale: 500, offset: -20, noise: 1.0}
"""


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(SystemFileError) as caught:
        parse_system(text, "rig.yaml")
    assert "\n" not in str(caught.value)
    return caught.value.problems


def converted(system: System, name: str, recorded: float) -> float:
    channel = next(c for c in system.channels if c.name == name)
    return channel.gain * recorded + channel.offset


@pytest.mark.parametrize("hidden", ["\\u202e", "\\x1b[31m", "\\u200b", "\\n"])
def test_texts_with_characters_that_nobody_sees_are_refused(hidden: str) -> None:
    (problem,) = problems(RIG.replace("name: rig", f'name: "a{hidden}b"'))
    assert problem.startswith("rig.yaml: line 2: ") and "invisible character (U+" in problem and problem.isprintable()
    (problem,) = problems(RIG.replace("column: acc", f'column: "a{hidden}b"'))
    assert "invisible character" in problem
    assert parse_system(RIG.replace("name: rig", "name: |\n  rig\n")).name == "rig"


def test_recorded_numbers_become_si_by_scale_offset_sign_and_unit() -> None:
    system = parse_system(RIG)
    assert converted(system, "rod.displacement", 12.0) == pytest.approx(0.012)
    assert converted(system, "top", 1.0) == 9.80665
    assert converted(system, "rolls", 180.0) == pytest.approx(-np.pi)
    assert converted(system, "cell", 2.0) == 980.0
    assert [c.table for c in system.channels] == ["stroke", "acc", "gyro_x", "gyro_y", "3"]


@pytest.mark.parametrize(
    ("unit", "si", "one"),
    [
        ("kN", "N", 1000.0),
        ("lbf", "N", 4.4482216152605),
        ("kip", "N", 4448.2216152605),
        ("kgf", "N", 9.80665),
        ("lb", "kg", 0.45359237),
        ("in", "m", 0.0254),
        ("in/s", "m/s", 0.0254),
        ("ft/s²", "m/s^2", 0.3048),
        ("mm/s2", "m/s^2", 0.001),
        ("m/s/s", "m/s^2", 1.0),
        ("g", "m/s^2", 9.80665),
        ("g", "kg", 0.001),
        ("[µm]", "m", 1e-6),
        ("°/s", "rad/s", np.pi / 180),
        ("rpm", "rad/s", 2 * np.pi / 60),
        ("bar", "Pa", 1e5),
        ("psi", "Pa", 6894.757293168361),
        ("km/h", "m/s", 1 / 3.6),
        ("msec", "s", 1e-3),
    ],
)
def test_units_are_what_the_standards_say(unit: str, si: str, one: float) -> None:
    assert to_si(unit, si, None, 0.0, 1) == pytest.approx((one, 0.0), rel=1e-12, abs=0.0)


def test_every_unit_of_the_tables_is_found_by_its_own_name() -> None:
    for si, names in FACTORS.items():
        assert names[si] == 1.0
        for name, factor in names.items():
            zero = -(3.0 + ZEROS.get(name, 0.0)) * factor
            assert to_si(name, si, 2.0, 3.0, -1) == pytest.approx((-2 * factor, zero))
    assert to_si("degF", "degC", None, 212.0, 1)[1] == pytest.approx(100.0)
    assert to_si("K", "degC", None, 0.0, 1) == (1.0, -273.15)


def test_a_unit_of_something_else_is_refused_and_volts_need_a_scale() -> None:
    with pytest.raises(UnitError, match=r"'mm' is no unit of N; known are N, mN"):
        to_si("mm", "N", None, 0.0, 1)
    with pytest.raises(UnitError, match=r"did you mean 'kN'"):
        to_si("KN", "N", None, 0.0, 1)
    with pytest.raises(UnitError, match=r"mV alone does not determine N; give `scale:` in N per V"):
        to_si("mV", "N", None, 0.0, 1)
    assert to_si("mV", "N", 2000.0, 5.0, -1) == (-2.0, -5.0)


def test_a_rate_sensor_measures_the_degree_of_freedom_that_turns() -> None:
    mechanics = parse_system(RIG).mechanics
    _, _, C, D = mechanics.matrices()
    rate = {dof: mechanics.n + i for i, dof in enumerate(mechanics.dofs)}
    for row, dof in ((1, "mass.roll"), (2, "mass.pitch")):
        assert C[row, rate[dof]] == 1.0
        assert np.count_nonzero(C[row]) == 1
        assert not D[row].any()
    (line,) = problems(RIG.replace(", pitch_inertia: 0.2", ""))
    assert line.endswith("sensors.pitches.body: mass has no pitch_inertia, so it does not pitch")


def test_time_of_tables_has_a_column_a_unit_and_an_epoch() -> None:
    time = parse_system(RIG).time
    assert (time.name, time.seconds, time.rate) == ("Zeit", 1e-3, None)
    assert time.epoch == 1_790_000_000_000_000_000 - 800 * 10**9
    labview = parse_system(RIG.replace("unit: ms, epoch: 2026-09-21T14:00:00Z", "epoch: labview")).time
    assert labview.epoch == -(date(1970, 1, 1) - date(1904, 1, 1)).days * 86400 * 10**9
    days = parse_system(RIG.replace("unit: ms, epoch: 2026-09-21T14:00:00Z", "unit: d, epoch: matlab")).time
    assert days.epoch is not None and 719529 * 86400 * 10**9 + days.epoch == 0  # datenum of 1970-01-01


def test_what_only_says_where_data_are_does_not_change_the_digest() -> None:
    base = parse_system(RIG).digest
    moved = RIG.replace("unit: mm", "unit: in, sign: -1").replace("column: stroke", "csv: x").replace("Zeit", "t")
    assert parse_system(moved).digest == base
    assert parse_system(RIG.replace("kind: support", "kind: displacement")).digest == base
    assert parse_system(RIG.replace("noise: 1e-6", "noise: 2e-6")).digest != base
    assert load_system().digest == "9861e064700180be"  # the bundled weights belong to it


@pytest.mark.parametrize(
    ("old", "new", "channels"),
    [
        ("displacement: {csv: z, noise: 1e-5}, velocity", "velocity", ["road.velocity"]),
        (
            "displacement: {csv: z, noise: 1e-5}, velocity: {csv: vz",
            "acceleration: {csv: az",
            ["road.acceleration"],
        ),
        (
            "velocity: {csv: vz, noise: 1e-3}",
            "acceleration: {csv: az}",
            ["road.displacement", "road.acceleration"],
        ),
    ],
)
def test_a_support_may_give_any_of_its_motions(old: str, new: str, channels: list[str]) -> None:
    system = System(parse_system_file(QUARTER_CAR.replace(old, new)))
    assert [c.name for c in system.inputs] == channels
    assert [c.unit for c in system.inputs] == [SI[name.split(".")[1]] for name in channels]


def test_track_load_speed_and_tests_without_a_body_can_be_said() -> None:
    track = "road: {kind: track, rail: left, position: [0.0, 1.0]}"
    system = System(
        parse_system_file(
            QUARTER_CAR.replace(
                "road: {kind: displacement, displacement: {csv: z, noise: 1e-5}, velocity: {csv: vz, noise: 1e-3}}",
                track,
            )
            .replace("mass: 300.0", "mass: 300.0, load: {min: -50, max: 100, pressure: {csv: p, unit: bar}}")
            .replace("window: 200", "window: 200\nspeed: {csv: v, unit: km/h}")
        )
    )
    assert [(c.name, c.unit) for c in system.inputs] == [("speed", "m/s")]  # says how late the wheels are
    assert [(c.name, c.unit) for c in system.auxiliary] == [("sprung.pressure", "Pa")]
    assert system.inputs[0].gain == pytest.approx(1 / 3.6)
    parse_system_file(
        "{name: dyno, sample_rate: 100, window: 64, bodies: {},"
        " inputs: {rod: {kind: support, displacement: {csv: x}}},"
        " elements: {damper: {upper: rod, lower: ground, damping: 100.0}},"
        " sensors: {cell: {kind: force, element: damper, csv: F}}, estimate: [damping]}"
    )


SINGLE = """
name: machine
sample_rate: 100
window: 200
bodies: {machine: {mass: 1000}}
inputs: {floor: {kind: support, acceleration: {csv: f, noise: 0.01}}}
elements: {mount: {upper: machine, lower: floor, stiffness: 4.0e+5, damping: 4000}}
sensors: {top: {kind: acceleration, body: machine, csv: a, noise: 0.01}}
"""


def test_a_mass_that_is_only_seen_in_proportion_to_the_springs_is_no_load() -> None:
    assert parse_system(SINGLE).loads == ()
    with pytest.raises(SystemFileError, match=r"bodies\.machine\.load: its mass is only seen in proportion"):
        parse_system(SINGLE.replace("mass: 1000", "mass: 1000, load: true"))
    for known in (
        SINGLE.replace("damping: 4000", "damping: {value: 4000, fixed: true}"),
        SINGLE.replace("sensors: {", "sensors: {cell: {kind: force, element: mount, csv: F}, "),
        SINGLE + "estimate: [stiffness]\n",
        SINGLE.replace("{machine: {mass: 1000}}", "{machine: {mass: 1000}, frame: {mass: 90}}").replace(
            "elements: {", "elements: {foot: {upper: frame, lower: floor, stiffness: 1.0e+6, damping: 900}, "
        ).replace("lower: floor, stiffness: 4", "lower: frame, stiffness: 4"),
    ):  # fmt: skip
        assert [load.body for load in parse_system(known).loads] == ["machine"]
    two = SINGLE.replace("{machine: {mass: 1000}}", "{machine: {mass: 1000}, other: {mass: 90}}")
    two = two.replace("elements: {", "elements: {foot: {upper: other, lower: floor, stiffness: 1.0e+6, damping: 900}, ")
    two = two.replace("sensors: {", "sensors: {there: {kind: acceleration, body: other, csv: b}, ")
    assert parse_system(two).loads == ()  # beside each other, neither says how heavy the other is


def test_a_single_body_on_measured_supports_is_tracked() -> None:
    system, rng = parse_system(SINGLE), np.random.default_rng(3)
    values = simulate_runs(system, np.tile([0.05, -0.1], (8, 1)), system.window, rng).values
    found = Identifier(system).examine(values, np.ones(len(values), dtype=bool))
    assert all(one.informative and one.identifiable.all() for one in found)
    errors = np.array([(one.log_ratio - [0.05, -0.1]) / np.sqrt(one.covariance.diagonal()) for one in found])
    assert np.abs(errors).max() < 4.0


def test_windows_with_inputs_alone_are_not_identified_also_where_inputs_are_lost() -> None:
    text = SINGLE.replace("inputs: {", "inputs: {wall: {kind: support, velocity: {csv: w, noise: 0.001}}, ")
    text = text.replace(
        "elements: {", "elements: {arm: {upper: machine, lower: wall, stiffness: 1.0e+5, damping: 900}, "
    )
    system, rng = parse_system(text), np.random.default_rng(3)
    values = simulate_runs(system, np.zeros((3, 4)), system.window, rng).values
    values[0, :, 2] = np.nan
    values[1, :, 1:] = np.nan
    for found in (Identifier(system).examine(values, np.ones(3, dtype=bool)), Identifier(system).identify(values)):
        assert [one.identified for one in found] == [False, False, True]
        assert found[1].reason == "missing sensor top"


def test_a_key_that_belongs_elsewhere_is_not_proposed() -> None:
    with pytest.raises(SystemFileError, match=r"inputs\.floor\.position: this key has no place here"):
        parse_system(SINGLE.replace("kind: support", "kind: support, position: [0, 0]"))


BROKEN = """
name: rig
sample_rate: fast
window: 4
colour: red
time: {unit: fortnight}
bodies:
  sprung: {mass: -300.0}
  unsprung: {mass: 40.0, load: {min: 5, max: 1}}
inputs:
  road: {kind: displacment, displacement: {csv: z, noise: 1e-5}}
  push: {kind: force, body: sprng, csv: F, unit: kNN}
  rod: {kind: support}
elements:
  tyre: {upper: unsprung, lower: rod, stiffness: soft, damping: 100.0}
  strut: {upper: sprung, lower: unsprugn, stiffness: 2.0e4, damping: 1500.0}
  strut: {upper: sprung, lower: unsprung, stiffness: 0.0, damping: 1500.0}
sensors:
  body: {kind: acceleration, body: sprung, csv: a1, unit: V, nois: 1}
  wheel: {kind: velocity, body: unsprung, mcap: foo, sign: 2}
  cell: {kind: force, element: strutt}
estimate: [stiffness, colour]
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass: 300.0", "mass: 1e300", "bodies.sprung.mass: must be less than or equal to 1e+30, not 1e+300"),
        ("mass: 300.0", "mass: 1e-300", "bodies.sprung.mass: must be 0, or at least 1e-30"),
        ("stiffness: 2.0e4", "stiffness: 1e300", "elements.strut.stiffness: must be less than or equal to 1e+30"),
        ("noise: 1e-5", "noise: 1e-300", "inputs.road.displacement.noise: must be 0, or at least 1e-30"),
        ("window: 200", "window: 1000000000", "window: must be less than or equal to 10000"),
        ("sample_rate: 200", "sample_rate: 1e9", "sample_rate: must be less than or equal to 1e+06"),
        (
            "bodies:\n",
            "bodies:\n" + "".join(f"  b{i}: {{mass: 1}}\n" for i in range(300)),
            "bodies: at most 200 are possible",
        ),
    ],
)
def test_values_that_cannot_be_calculated_with_are_refused(old: str, new: str, message: str) -> None:
    assert old in QUARTER_CAR
    assert any(message in line for line in problems(QUARTER_CAR.replace(old, new, 1)))


def test_a_value_of_many_characters_is_not_repeated_whole() -> None:
    (line,) = problems(QUARTER_CAR.replace("sample_rate: 200", f"sample_rate: {'fast' * 10_000}"))
    assert "a number is expected, not 'fastfast" in line and len(line) < 200


def test_everything_that_is_wrong_is_reported_at_once_in_plain_words(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = problems(BROKEN)
    for part in (
        "line 3: sample_rate: a number is expected, not 'fast'",
        "line 4: window: must be greater than or equal to 8, not 4",
        "line 5: colour: unknown key",
        "line 6: time.unit: 'fortnight' is no unit of time; known are s, ms",
        "line 8: bodies.sprung.mass: must be greater than or equal to 0, not -300.0",
        "line 9: bodies.unsprung.load: min must be less than max",
        "line 11: inputs.road: kind 'displacment' is unknown here; known are displacement, support, track, force; "
        "did you mean 'displacement'?",
        "line 12: inputs.push.body: 'sprng' is not a body; did you mean 'sprung'?",
        "line 12: inputs.push.unit: 'kNN' is no unit of N; did you mean 'kN'?",
        "line 13: inputs.rod: give at least one of displacement, velocity, acceleration",
        "line 15: elements.tyre.stiffness: a number or a mapping is expected, not 'soft'",
        "line 17: strut: this key occurs twice",
        "line 17: elements.strut.stiffness: a nominal value of 0 cannot be estimated",
        "line 19: sensors.body.nois: unknown key; did you mean 'noise'?",
        "line 20: sensors.wheel.mcap: /topic.field is expected, not 'foo'",
        "line 20: sensors.wheel.sign: one of 1, -1 is expected, not 2",
        "line 21: sensors.cell.element: 'strutt' is not an element; did you mean 'strut'?",
        "line 22: estimate.1: one of stiffness, damping, mass is expected, not 'colour'",
    ):
        assert any(part in line for line in lines), part
    assert len(lines) == 18
    path = tmp_path / "rig.yaml"
    path.write_text(BROKEN)
    assert main(["system", str(path)]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(f"sprung: {path}: 18 problems: line ") and len(err.splitlines()) == 1
    assert main(["replay", str(path), "--system", str(path)]) == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


def test_the_schema_for_editors_knows_short_forms_and_every_kind(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["system", "--schema"]) == 0
    schema = json.loads(capfd.readouterr().out)
    assert schema == json_schema()
    assert set(schema["properties"]) >= {"name", "time", "speed", "bodies", "inputs", "elements", "sensors"}
    mass = schema["$defs"]["Body"]["properties"]["mass"]
    assert {"type": "number"} in mass["anyOf"]
    (entry,) = schema["properties"]["inputs"]["patternProperties"].values()
    assert set(entry["discriminator"]["mapping"]) == {"displacement", "support", "track", "force"}


FOLLOWED = """
name: damper
sample_rate: 100
window: 64
inputs: {rod: {kind: displacement, displacement: {csv: d}}}
signals: {valve: {csv: U, unit: V, scale: 2.0}}
elements: {damper: {upper: rod, lower: ground, stiffness: 1e3, damping: 1e3, depends_on: [%s]}}
sensors: {cell: {kind: force, element: damper, csv: F}}
"""


def test_signals_that_parameters_follow_are_channels_of_their_own() -> None:
    system = parse_system(FOLLOWED % "valve")
    (valve,) = system.signals
    assert (valve.name, valve.unit, valve.csv, valve.gain) == ("valve", "V", "U", 2.0)
    assert "valve" not in [channel.name for channel in system.channels]
    assert system.digest == parse_system(FOLLOWED % "").digest  # no window sees it


def test_a_signal_that_nobody_measures_is_an_error_with_the_likely_one() -> None:
    with pytest.raises(SystemFileError, match="did you mean 'valve'"):
        parse_system(FOLLOWED % "vavle")


TENFOLD = "a: &a [x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x: " + "[" * 5000, "nested more than 50 deep"),
        ("- " * 5000, "nested more than 50 deep"),
        ("x: [" + "1," * 100_000 + "1]", "names and values"),
        (TENFOLD + "estimate: [*i]", "names and values"),
        ("a: &a [*a]", "refers to itself"),
        ("!!timestamp 9999999999", "not YAML"),
        ("!!bool x", "not YAML"),
    ],
)
def test_yaml_that_costs_or_breaks_is_refused_in_one_line_at_once(
    text: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.model.systemfile.MOST_NODES", 2000)
    began = time.process_time()
    with pytest.raises(SystemFileError, match=message) as caught:
        parse_system_file(text)
    assert "\n" not in str(caught.value)
    assert time.process_time() - began < 2


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("\tcar: {mass: 1}", "line 3: not YAML: .*; indent with spaces, not with tabs$"),
        ("  a: b: c", "line 3: not YAML: mapping values are not allowed here$"),
    ],
)
def test_what_is_not_yaml_is_told_with_its_line_alone(line: str, message: str) -> None:
    with pytest.raises(SystemFileError, match=message) as caught:
        parse_system_file(f"name: x\nbodies:\n{line}\n")
    assert "unicode string" not in str(caught.value)
