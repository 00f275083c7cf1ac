"""A system as Modelica text: one model, one block per law; no library is needed but the Modelica language itself."""

from __future__ import annotations

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


def _vehicle(system: System, laws: list[EquationSite]) -> list[str]:
    m = system.mechanics
    dofs = [identifier(dof) for dof in m.dofs]
    names = [identifier(element) for element in system.all_elements]
    lines = ["  model Vehicle"]
    for e, name in enumerate(names):
        lines.append(f'    parameter Real {name}_stiffness = {float(m.stiffness[e])!r} "N/m";')
        lines.append(f'    parameter Real {name}_damping = {float(m.damping[e])!r} "N.s/m";')
    drives: dict[int, str] = {}
    at = 0
    for source_name, source in system.file.inputs.items():
        quantities = ["force"] if source.kind == "force" else ["displacement", "velocity"]
        for quantity in quantities:
            drives[at] = f"{identifier(source_name)}_{quantity}"
            lines.append(f"    input Real {drives[at]};")
            at += 1
    lines += [f"    output Real {identifier(sensor)};" for sensor in system.sensors]
    for dof in dofs:
        lines.append(f"    Real {dof}(start = 0.0, fixed = true);")
        lines.append(f"    Real {dof}_rate(start = 0.0, fixed = true);")
    lines += [f"    Real d_{name}, v_{name}, f_{name};" for name in names]
    lines += [f"    {_name(site, index)} law_{index};" for index, site in enumerate(laws)]
    lines.append("  equation")
    lines += [f"    der({dof}) = {dof}_rate;" for dof in dofs]
    value, slope = ([drives[int(i) + part] for i in m.support_drive] for part in (0, 1))
    rates = [f"{dof}_rate" for dof in dofs]
    for e, name in enumerate(names):
        for motion, above, below in (("d", dofs, value), ("v", rates, slope)):
            found = total(linear(m.H[e], above.__getitem__), linear(m.G[e], below.__getitem__))
            lines.append(f"    {motion}_{name} = {found};")
        own = f"{name}_stiffness * d_{name} + {name}_damping * v_{name}"
        added = [f"{float(s.weights[e])!r} * law_{i}.f" for i, s in enumerate(laws) if s.weights[e]]
        lines.append(f"    f_{name} = {total(own, *added)};")
    for i, site in enumerate(laws):
        element = names[site.element]
        lines += [
            f"    law_{i}.d = {linear(site.weights, lambda e: f'd_{names[e]}')};",
            f"    law_{i}.v = {linear(site.weights, lambda e: f'v_{names[e]}')};",
            f"    law_{i}.k = {element}_stiffness;",
            f"    law_{i}.c = {element}_damping;",
        ]
    for i, dof in enumerate(dofs):
        pull = linear(-m.H[:, i], lambda e: f"f_{names[e]}")
        push = linear(m.F[i], lambda j: drives[int(m.force_drive[j])])
        lines.append(f"    {float(m.mass[i])!r} * der({dof}_rate) = {total(pull, push)};")
    for s, sensor in enumerate(system.sensors):
        shown = output(
            system,
            s,
            dofs.__getitem__,
            rates.__getitem__,
            lambda i: f"der({rates[i]})",
            lambda e: f"d_{names[e]}",
            lambda e: f"f_{names[e]}",
        )
        lines.append(f"    {identifier(sensor)} = {shown};")
    return [*lines, "  end Vehicle;", ""]
