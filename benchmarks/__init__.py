"""What `sprung bench NAME` runs.

A benchmark is a module with `run(...)`, which yields figures as dicts that JSON can hold; its keyword arguments are
the options of the command.  One line in the table makes it known; it is imported when it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

BENCHMARKS: dict[str, tuple[str, str]] = {  # name: (module, what it measures)
    "identify": ("sprung.benchmarks.identify", "accuracy and speed of window estimates, against the Cramer-Rao bound"),
    "estimator": ("sprung.benchmarks.estimator", "iterations saved by the trained start, against the paper's feature"),
    "simulate": ("sprung.benchmarks.simulate", "windows simulated per second, against torchdiffeq and scipy"),
    "decode": ("sprung.benchmarks.decode", "frames and messages per second, against cantools and mcap"),
    "replay": ("sprung.benchmarks.replay", "recording to stored drift: times real time, and memory over length"),
    "fleet": (
        "sprung.benchmarks.fleet",
        "one process and many: identity, scaling, load, kills, edge, a plan on paper",
    ),
    "serve": ("sprung.benchmarks.serve", "latency of POST /identify, against a bare echo"),
    "pages": ("sprung.benchmarks.pages", "what a person waits for: a large fleet, a vehicle's page, a month"),
    "trust": ("sprung.benchmarks.trust", "windows acknowledged, lost and doubled while the service is killed"),
    "drift": ("sprung.benchmarks.drift", "delay of alarms and false alarms of the tracker"),
    "sensing": ("sprung.benchmarks.sensing", "every set of sensors: error over the Cramer-Rao bound, coverage"),
    "sensors": ("sprung.benchmarks.sensors", "wrong gains, delays, signs, channels: named, and no spring accused"),
    "nonlinear-tracking": (
        "sprung.benchmarks.nonlinear_tracking",
        "vehicles with laws in their file: coverage, errors, windows per second, drift of a law",
    ),
    "exchange": ("sprung.benchmarks.exchange", "exports read by other programs, against our own free run"),
    "experiment": ("sprung.benchmarks.experiment", "the next run for look-alikes: against chance and T-optimality"),
    "day": (
        "sprung.benchmarks.day",
        "months of service: weather, loads, clocks, drifting gains; false alarms, hidden faults",
    ),
    "load": ("sprung.benchmarks.load", "passengers board at a stop, off the middle too: alarms, load, 24 parameters"),
    "ambient": ("sprung.benchmarks.ambient", "nothing measured below: error over the Cramer-Rao bound, coverage"),
    "comfort": ("sprung.benchmarks.comfort", "what a failing element costs in comfort: foreseen and simulated"),
    "concealed": ("sprung.benchmarks.concealed", "missing physics: found, placed and named, against PySINDy"),
    "open-catalogue": (
        "sprung.benchmarks.open_catalogue",
        "concealed laws that no catalogue has: formulas, their error on held-out motion and at 1.5 times the amplitude",
    ),
    "structure": (
        "sprung.benchmarks.structure",
        "parts that the file does not state: connections, hanging masses, lever arms; named, and none invented",
    ),
    "several-laws": (
        "sprung.benchmarks.several_laws",
        "three to five laws at once, two at one element",
    ),
    "silverbox": ("sprung.benchmarks.silverbox", "missing physics in the Silverbox record (--data DIR)"),
    "real": ("sprung.benchmarks.real", "measured dampers, an axis and a beam, beside references (--data DIR)"),
    "video": ("sprung.benchmarks.real_video", "real videos: the length of their pendulums (--data DIR)"),
    "length": ("sprung.benchmarks.length", "processor time and memory of a diagnosis over the recording's length"),
    "linear-rigs": (
        "sprung.benchmarks.linear_rigs",
        "linear rigs on a shaker, whose values alone are off: what is named on them is false",
    ),
    "setups": (
        "sprung.benchmarks.setups",
        "wrong set-ups on simulated recordings: signs, channels, nodes, scales, positions, bodies",
    ),
    "sensor-errors": (
        "sprung.benchmarks.sensor_errors",
        "errors of sensors that are in no list, with and without concealed physics beside them",
    ),
    "setup-rigs": ("sprung.benchmarks.setup_rigs", "wrong set-ups of rigs that are no train"),
    "cars": ("sprung.benchmarks.cars", "what cars do that their files leave out"),
    "naming": (
        "sprung.benchmarks.naming",
        "component tests of what rigs do, listed or not: right, unknown, wrong, missed",
    ),
    "shaken": ("sprung.benchmarks.shaken", "simulated buildings on shaken ground, quarter cars with stops and valves"),
    "sensitivity": (
        "sprung.benchmarks.sensitivity",
        "what a diagnosis says when one of its deciding numbers is another",
    ),
    "tracking-rules": (
        "sprung.benchmarks.tracking_rules",
        "what a tracker says when one of its deciding numbers is another",
    ),
    "emps": ("sprung.benchmarks.emps", "missing physics in the EMPS record (--data DIR)"),
    "paper": ("sprung.benchmarks.paper", "the paper's systems, baselines and ablations"),
    "paper-cells": ("sprung.benchmarks.rerun_paper", "random figures of docs/paper.md, made again"),
    "paper-compare": ("sprung.benchmarks.paper_report.compare", "two of its methods: ratios, intervals, p"),
    "paper-keep": ("sprung.benchmarks.paper_report.kept", "rows of the paper's benchmark into docs/paper-rows.zip"),
    "paper-report": ("sprung.benchmarks.paper_report", "rows of the paper's benchmark into docs/paper.md"),
    "physics-overhead": ("sprung.benchmarks.physics_overhead", "what physics in the loop costs a training update"),
}

Figures = Iterator[dict[str, Any]]


def load(name: str) -> Callable[..., Figures]:
    """The `run` of a benchmark in the table."""
    run: Callable[..., Figures] = import_module(BENCHMARKS[name][0]).run
    return run
