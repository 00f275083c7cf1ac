"""A system as Modelica text: one model, one block per law; no library is needed but the Modelica language itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sprung.model.exchange.equations import EquationSite, identifier, linear, output, sites, total
from sprung.model.laws import CLOCK_LEAD
from sprung.model.system import System


def write_modelica(path: Path, system: System) -> None:
    """Write a package with the model and its laws.  Errors: `ExchangeError` for laws without a formula."""
    path.write_text(modelica(system, identifier(path.stem)), encoding="utf-8")


def modelica(system: System, package: str) -> str:
    """The text of a package: blocks of the laws, then `Vehicle` with inputs, outputs and parameters by name."""
    system = system.whole_system
    laws = sites(system)
    blocks = [line for index, site in enumerate(laws) for line in _block(site, index)]
    lines = [
        f"package {package} {_text(f'{system.name}, written by Sprung')}",
        *blocks,
        *_vehicle(system, laws),
        f"end {package};",
    ]
    return "\n".join(lines) + "\n"


def _name(site: EquationSite, index: int) -> str:
    return f"{identifier(site.law.name)}_{identifier(site.placed.location)}_{index}"


def _text(words: str) -> str:
    escaped = words.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _block(site: EquationSite, index: int) -> list[str]:
    """A law: its motion in, its force out."""
    name = _name(site, index)
    own_names = {own: identifier(f"{own}_" if own == "f" else own) for own in site.law.names}
    rename = own_names | {"t": f"(time + {CLOCK_LEAD!r})"}
    lines = [f"  block {name} {_text(f'{site.law.title} at {site.placed.location}')}"]
    for own, value, spec in zip(site.law.names, site.placed.values, site.law.parameters, strict=True):
        lines.append(f"    parameter Real {own_names[own]} = {value!r} {_text(spec.unit)};")
    lines += [
        '    input Real d "deflection, m";',
        '    input Real v "rate, m/s";',
        '    input Real k "stiffness of its element, N/m";',
        '    input Real c "damping of its element, N.s/m";',
        '    output Real f "force, N";',
    ]
    if site.memory is not None:
        lines.append("    Real z(start = 0.0, fixed = true);")
    lines += ["  equation", f"    f = {site.force.modelica(rename)};"]
    if site.memory is not None:
        lines.append(f"    der(z) = {site.memory.modelica(rename)};")
    return [*lines, f"  end {name};", ""]


@dataclass(frozen=True)
class _ModelicaNames:
    """Identifiers of a vehicle's variables."""

    dofs: list[str]
    elements: list[str]
    drives: list[str]  # inputs, in the order of the mechanics

    @classmethod
    def of(cls, system: System) -> _ModelicaNames:
        drives = [
            f"{identifier(name)}_{quantity}"
            for name, source in system.file.inputs.items()
            for quantity in (["force"] if source.kind == "force" else ["displacement", "velocity"])
        ]
        dofs = [identifier(dof) for dof in system.mechanics.dofs]
        return cls(dofs, [identifier(element) for element in system.all_elements], drives)


def _vehicle(system: System, laws: list[EquationSite]) -> list[str]:
    names = _ModelicaNames.of(system)
    return [
        "  model Vehicle",
        *_declarations(system, laws, names),
        "  equation",
        *[f"    der({dof}) = {dof}_rate;" for dof in names.dofs],
        *_element_equations(system, laws, names),
        *_law_equations(laws, names),
        *_motion_equations(system, names),
        *_sensor_equations(system, names),
        "  end Vehicle;",
        "",
    ]


def _declarations(system: System, laws: list[EquationSite], names: _ModelicaNames) -> Iterator[str]:
    m = system.mechanics
    for e, name in enumerate(names.elements):
        yield f'    parameter Real {name}_stiffness = {float(m.stiffness[e])!r} "N/m";'
        yield f'    parameter Real {name}_damping = {float(m.damping[e])!r} "N.s/m";'
    for drive in names.drives:
        yield f"    input Real {drive};"
    for sensor in system.sensors:
        yield f"    output Real {identifier(sensor)};"
    for dof in names.dofs:
        yield f"    Real {dof}(start = 0.0, fixed = true);"
        yield f"    Real {dof}_rate(start = 0.0, fixed = true);"
    for name in names.elements:
        yield f"    Real d_{name}, v_{name}, f_{name};"
    for index, site in enumerate(laws):
        yield f"    {_name(site, index)} law_{index};"


def _element_equations(system: System, laws: list[EquationSite], names: _ModelicaNames) -> Iterator[str]:
    """Deflections, rates and forces."""
    m = system.mechanics
    value, slope = ([names.drives[int(i) + part] for i in m.support_drive] for part in (0, 1))
    rates = [f"{dof}_rate" for dof in names.dofs]
    for e, name in enumerate(names.elements):
        for motion, above, below in (("d", names.dofs, value), ("v", rates, slope)):
            found = total(linear(m.H[e], above.__getitem__), linear(m.G[e], below.__getitem__))
            yield f"    {motion}_{name} = {found};"
        own = f"{name}_stiffness * d_{name} + {name}_damping * v_{name}"
        added = [f"{float(s.weights[e])!r} * law_{i}.f" for i, s in enumerate(laws) if s.weights[e]]
        yield f"    f_{name} = {total(own, *added)};"


def _law_equations(laws: list[EquationSite], names: _ModelicaNames) -> Iterator[str]:
    for i, site in enumerate(laws):
        element = names.elements[site.element]
        yield f"    law_{i}.d = {linear(site.weights, lambda e: f'd_{names.elements[e]}')};"
        yield f"    law_{i}.v = {linear(site.weights, lambda e: f'v_{names.elements[e]}')};"
        yield f"    law_{i}.k = {element}_stiffness;"
        yield f"    law_{i}.c = {element}_damping;"


def _motion_equations(system: System, names: _ModelicaNames) -> Iterator[str]:
    m = system.mechanics
    for i, dof in enumerate(names.dofs):
        pull = linear(-m.H[:, i], lambda e: f"f_{names.elements[e]}")
        push = linear(m.F[i], lambda j: names.drives[int(m.force_drive[j])])
        yield f"    {float(m.mass[i])!r} * der({dof}_rate) = {total(pull, push)};"


def _sensor_equations(system: System, names: _ModelicaNames) -> Iterator[str]:
    for s, sensor in enumerate(system.sensors):
        shown = output(
            system,
            s,
            names.dofs.__getitem__,
            lambda i: f"{names.dofs[i]}_rate",
            lambda i: f"der({names.dofs[i]}_rate)",
            lambda e: f"d_{names.elements[e]}",
            lambda e: f"f_{names.elements[e]}",
        )
        yield f"    {identifier(sensor)} = {shown};"
