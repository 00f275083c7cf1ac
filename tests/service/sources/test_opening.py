"""When a recording began whose times count from 0: as stated, or else as the file says, which is reported."""

import os
from pathlib import Path

import pytest

from sprung.model.system import parse_system
from sprung.service.sources.opening import open_stream

SYSTEM = """
name: car
sample_rate: 100
window: 100
bodies:
  body: {mass: 400}
inputs:
  road: {kind: support, displacement: {csv: z}}
elements:
  strut: {upper: body, lower: road, stiffness: 2.0e+4, damping: 1500}
sensors:
  top: {kind: acceleration, body: body, csv: a}
"""
WRITTEN = 1_790_000_000  # 2026-09-21T14:13:20Z


@pytest.mark.parametrize("start", [None, WRITTEN * 10**9])
def test_a_start_that_is_only_the_file_s_own_time_is_said_to_be(tmp_path: Path, start: int | None) -> None:
    path = tmp_path / "ride.csv"
    path.write_text("time,z,a\n" + "".join(f"{i / 100},{i % 7},{i % 5}\n" for i in range(300)))
    os.utime(path, (WRITTEN, WRITTEN))
    recording = open_stream(path, parse_system(SYSTEM), start=start)
    assert next(recording.blocks()).time[0] == WRITTEN * 10**9
    (line,) = recording.problems
    assert line.startswith("its times count from 0, which is taken to be 2026-09-21 14:13:20 UTC")
    assert ("the file's own time" in line) == (start is None)
