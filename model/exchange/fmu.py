"""A system with its laws as an FMU 2.0 (co-simulation and model exchange) with its C sources.

Inputs are the drives (displacement and velocity of every support, measured forces), outputs the sensors, parameters
the elements' stiffness and damping and the laws' values; all can be set before a run.  FMI 2.0.4 specification.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from sprung.model.exchange.equations import EquationSite, identifier, linear, output, sites
from sprung.model.exchange.statespace import ExchangeError, state_space
from sprung.model.laws import CLOCK_LEAD
from sprung.model.mechanics import Mechanics
from sprung.model.simulate.ride import with_values
from sprung.model.system import System

RUNTIME = Path(__file__).parent / "fmi2.c"
_STEPS_PER_RADIAN = 20.0  # of the fastest eigenvalue, Runge-Kutta 4: error 1e-7 a period
_PLATFORMS = {("Linux", "x86_64"): "linux64", ("Linux", "aarch64"): "aarch64-linux", ("Darwin", "arm64"): "darwin64"}
_LIBRARY = {"Darwin": ".dylib"}  # what FMI calls binaries, elsewhere .so


def write_fmu(path: Path, system: System) -> None:
    """Write `path`.fmu: sources, and the binary for this machine made by its C compiler (`cc`).

    Errors: `ExchangeError` for laws without a formula and where the compiler fails.
    """
    name, system = identifier(system.name), system.whole_system
    laws = sites(system)
    equations = _equations(system, laws)
    guid = "{" + hashlib.sha256(equations.encode()).hexdigest()[:32] + "}"
    header = f'#define GUID "{guid}"\n{equations}'
    with tempfile.TemporaryDirectory() as folder:
        sources = Path(folder) / "sources"
        sources.mkdir()
        (sources / "equations.h").write_text(header, encoding="utf-8")
        shutil.copy(RUNTIME, sources / "fmi2.c")
        (Path(folder) / "modelDescription.xml").write_bytes(_description(system, laws, name, guid))
        _compile("cc", sources, Path(folder) / "binaries" / _platform(), name)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(Path(folder).rglob("*")):
                if file.is_file():
                    archive.write(file, file.relative_to(folder))


def _platform() -> str:
    key = platform.system(), platform.machine()
    if key not in _PLATFORMS:
        raise ExchangeError(f"no FMI name of this platform ({' '.join(key)}); export sources only")
    return _PLATFORMS[key]


def _compile(compiler: str, sources: Path, folder: Path, name: str) -> None:
    if shutil.which(compiler) is None:
        raise ExchangeError(f"{compiler}: no such C compiler; install one")
    folder.mkdir(parents=True)
    target = folder / f"{name}{_LIBRARY.get(platform.system(), '.so')}"
    command = [compiler, "-O2", "-std=c99", "-fPIC", "-shared", "-o", str(target), str(sources / "fmi2.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ExchangeError(f"{compiler}: {done.stderr.strip().splitlines()[-1] if done.stderr else 'failed'}")


def parameters(system: System, laws: list[EquationSite]) -> Iterator[tuple[str, float, str]]:
    """Name, value and unit of every parameter, in the order of their value references."""
    for quantity, unit in (("stiffness", "N/m"), ("damping", "N.s/m")):
        for name, value in zip(system.all_elements, getattr(system.mechanics, quantity).tolist(), strict=True):
            yield f"{name}.{quantity}", value, unit
    for placed in dict.fromkeys(site.placed for site in laws):
        for full, spec, value in zip(placed.names, placed.law.parameters, placed.values, strict=True):
            yield full, value, spec.unit


def _equations(system: System, laws: list[EquationSite]) -> str:
    """The generated header but for its GUID."""
    m, E, n = system.mechanics, len(system.all_elements), system.mechanics.n
    names = [name for name, _, _ in parameters(system, laws)]
    memories = [i for i, site in enumerate(laws) if site.memory is not None]
    lines = [
        f"#define NX {2 * n + len(memories)}",
        f"#define NU {m.drives}",
        f"#define NY {len(system.sensors)}",
        f"#define NP {len(names)}",
        f"#define INTERNAL_STEP {_internal_step(system)!r}",
        f"static const double defaults[] = {{{', '.join(repr(v) for _, v, _ in parameters(system, laws)) or '0'}}};",
        f"static const int rate_of[] = {{{', '.join(str(of) for of in _rates(m)) or '0'}}};",
        "static void motion(double time, const double *x, const double *u, const double *p, double *d, double *v,",
        "                   double *f, double *a, double *dz) {",
        "  (void)time, (void)p;",
    ]
    value = [f"u[{i}]" for i in m.support_drive]
    slope = [f"u[{i + 1}]" for i in m.support_drive]
    for e in range(E):
        lines.append(f"  d[{e}] = {linear(m.H[e], 'x[{}]'.format)} + {linear(m.G[e], value.__getitem__)};")
        moved = linear(m.G[e], slope.__getitem__)
        lines.append(f"  v[{e}] = {linear(m.H[e], lambda i: f'x[{n + i}]')} + {moved};")
        lines.append(f"  f[{e}] = p[{e}] * d[{e}] + p[{E + e}] * v[{e}];")
    for i, site in enumerate(laws):
        lines += _law(site, i, names, n + n + memories.index(i) if i in memories else None, memories, E)
    for i in range(n):
        push = linear(m.F[i], lambda j: f"u[{int(m.force_drive[j])}]")
        pull = linear(-m.H[:, i], "f[{}]".format)
        lines.append(f"  a[{i}] = ({pull} + {push}) / {float(m.mass[i])!r};")
    lines += ["}", *_entry_points(system, len(memories))]
    return "\n".join(lines) + "\n"


def _law(site: EquationSite, index: int, names: list[str], state: int | None, memories: list[int], E: int) -> list[str]:
    """Force of a law, added to the elements it acts on, and the rate of its state."""
    at = {own: f"p[{names.index(full)}]" for own, full in zip(site.law.names, site.placed.names, strict=True)}
    rename = at | {
        "d": f"d_{index}",
        "v": f"v_{index}",
        "t": f"(time + {CLOCK_LEAD!r})",
        "k": f"p[{site.element}]",
        "c": f"p[{E + site.element}]",
        "z": f"x[{state}]",
    }
    lines = [
        f"  double d_{index} = {linear(site.weights, 'd[{}]'.format)};",
        f"  double v_{index} = {linear(site.weights, 'v[{}]'.format)};",
        f"  (void)d_{index}, (void)v_{index};",
        f"  double f_{index} = {site.force.c(rename)};",
    ]
    lines += [f"  f[{e}] += {float(w)!r} * f_{index};" for e, w in enumerate(site.weights) if w]
    if site.memory is not None:
        lines.append(f"  dz[{memories.index(index)}] = {site.memory.c(rename)};")
    return lines


def _entry_points(system: System, memories: int) -> list[str]:
    E, n = len(system.all_elements), system.mechanics.n
    local = f"  double d[{E}], v[{E}], f[{E}], a[{max(n, 1)}], dz[{max(memories, 1)}];"
    call = "  motion(time, x, u, p, d, v, f, a, dz);"
    shown = [
        output(system, s, "x[{}]".format, lambda i: f"x[{n + i}]", "a[{}]".format, "d[{}]".format, "f[{}]".format)
        for s in range(len(system.sensors))
    ]
    return [
        "static void derivatives(double time, const double *x, const double *u, const double *p, double *dx) {",
        local,
        call,
        f"  for (int i = 0; i < {n}; i++) dx[i] = x[{n} + i], dx[{n} + i] = a[i];",
        f"  for (int i = 0; i < {memories}; i++) dx[{2 * n} + i] = dz[i];",
        "}",
        "static void outputs(double time, const double *x, const double *u, const double *p, double *y) {",
        local,
        call,
        *(f"  y[{s}] = {text};" for s, text in enumerate(shown)),
        "}",
    ]


def _rates(mechanics: Mechanics) -> list[int]:
    """For every drive the one that is its rate, -1 where none is."""
    supports = set(mechanics.support_drive.tolist())
    return [i + 1 if i in supports else -1 for i in range(mechanics.drives)]


def _internal_step(system: System) -> float:
    A, *_ = with_values(system, {}).matrices()
    fastest = float(np.abs(np.linalg.eigvals(A)).max(initial=1.0))
    return min(1 / system.sample_rate, 1 / (_STEPS_PER_RADIAN * fastest))


def _description(system: System, laws: list[EquationSite], name: str, guid: str) -> bytes:
    """modelDescription.xml."""
    space = state_space(system)
    given = list(parameters(system, laws))
    memories = [f"{site.placed.location}.{site.law.name}.z" for site in laws if site.memory is not None]
    several = [name if memories.count(name) == 1 else f"{name}{i + 1}" for i, name in enumerate(memories)]
    states = [*space.states, *several]
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=system.name,
        guid=guid,
        generationTool="Sprung",
        variableNamingConvention="flat",
        numberOfEventIndicators="0",
    )
    flags = {"modelIdentifier": name, "canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
    flags["providesDirectionalDerivative"] = "true"
    for kind, more in (
        ("ModelExchange", {}),
        ("CoSimulation", {"canHandleVariableCommunicationStepSize": "true", "canInterpolateInputs": "true"}),
    ):
        files = ElementTree.SubElement(ElementTree.SubElement(root, kind, flags | more), "SourceFiles")
        ElementTree.SubElement(files, "File", name="fmi2.c")
    variables = ElementTree.SubElement(root, "ModelVariables")
    reference = 0

    def add(label: str, causality: str, variability: str, real: dict[str, str], initial: str | None = None) -> None:
        nonlocal reference
        made = {"name": label, "valueReference": str(reference), "causality": causality, "variability": variability}
        variable = ElementTree.SubElement(variables, "ScalarVariable", made | ({"initial": initial} if initial else {}))
        ElementTree.SubElement(variable, "Real", real)
        reference += 1

    for label, value, _unit in given:
        add(label, "parameter", "tunable", {"start": repr(value)}, "exact")
    for label in space.inputs:
        add(label, "input", "continuous", {"start": "0.0"})
    for label in space.outputs:
        add(label, "output", "continuous", {}, "calculated")
    first = reference
    for label in states:
        add(label, "local", "continuous", {"start": "0.0"}, "exact")
    for i, label in enumerate(states):
        add(f"der({label})", "local", "continuous", {"derivative": str(first + i + 1)}, "calculated")
    structure = ElementTree.SubElement(root, "ModelStructure")
    output_at = range(len(given) + len(space.inputs) + 1, len(given) + len(space.inputs) + len(space.outputs) + 1)
    derivative_at = range(first + len(states) + 1, first + 2 * len(states) + 1)
    for title, indices in (
        ("Outputs", [*output_at]),
        ("Derivatives", [*derivative_at]),
        ("InitialUnknowns", [*output_at, *derivative_at]),
    ):
        group = ElementTree.SubElement(structure, title)
        for index in indices:
            ElementTree.SubElement(group, "Unknown", index=str(index))
    ElementTree.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root)
