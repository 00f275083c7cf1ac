"""An independent maker of recordings with concealed effects: truth for `sprung bench concealed`.

It shares no code with `model/`: it reads the system file with a plain YAML parser, assembles the vehicle itself,
integrates with a fixed-step Runge-Kutta method at 2 kHz (batched over recordings), draws its own track and writes
files.  What it makes reaches the product only through those files.
"""

from sprung.benchmarks.generator.draw import Case, draw_cases
from sprung.benchmarks.generator.make import make_recordings, write_set
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle

__all__ = ["Case", "Vehicle", "draw_cases", "make_recordings", "read_vehicle", "write_set"]
