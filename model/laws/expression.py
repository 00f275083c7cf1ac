"""Formulas of laws as text: checked, evaluated on arrays, and written in other languages.

A law's formula names its parameters, the element's `k` (N/m) and `c` (N s/m), deflection `d` (m), rate `v` (m/s), time
`t` (s on the laws' clock) and, with memory, `z`.  It is arithmetic with the functions of `FUNCTIONS`; nothing else of
Python is admitted, so that a formula from a file cannot do anything but calculate.

>>> law = parse("force * tanh(v / smoothing)", {"force", "smoothing", "v"})
>>> float(law(force=300.0, smoothing=0.01, v=1.0))
300.0
>>> law.c()
'(force * tanh((v / smoothing)))'
"""

from __future__ import annotations

import ast
import math
import operator
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_LONGEST = 1000  # characters of a formula
_MOST_INTEGER = 2**53  # beyond it integers are no doubles; larger numbers are written as 1e20
_parsing = threading.Lock()  # CPython 3.11 counts the depth of all threads' trees together (cpython#106905)
MOTION = ("d", "v", "t", "z", "k", "c")  # variables of a formula beside the law's parameters


class FormulaError(ValueError):
    """A formula that cannot be read; one line."""


@dataclass(frozen=True, slots=True)
class Function:
    """One function of the language and its names elsewhere."""

    arity: int
    numpy: Callable[..., Any]
    c: str
    modelica: str


FUNCTIONS: dict[str, Function] = {
    "abs": Function(1, np.abs, "fabs({0})", "abs({0})"),
    "sign": Function(1, np.sign, "(double)(({0} > 0) - ({0} < 0))", "sign({0})"),
    "tanh": Function(1, np.tanh, "tanh({0})", "tanh({0})"),
    "exp": Function(1, np.exp, "exp({0})", "exp({0})"),
    "log": Function(1, np.log, "log({0})", "log({0})"),
    "sqrt": Function(1, np.sqrt, "sqrt({0})", "sqrt({0})"),
    "sin": Function(1, np.sin, "sin({0})", "sin({0})"),
    "cos": Function(1, np.cos, "cos({0})", "cos({0})"),
    "min": Function(2, np.minimum, "fmin({0}, {1})", "min({0}, {1})"),
    "max": Function(2, np.maximum, "fmax({0}, {1})", "max({0}, {1})"),
}
_BINARY: dict[type[ast.operator], tuple[Callable[[Any, Any], Any], str]] = {
    ast.Add: (operator.add, "+"),
    ast.Sub: (operator.sub, "-"),
    ast.Mult: (operator.mul, "*"),
    ast.Div: (np.divide, "/"),
    ast.Pow: (np.power, "^"),
}


@dataclass(frozen=True, slots=True)
class Expression:
    """A checked formula."""

    text: str
    names: frozenset[str]  # that it uses
    tree: ast.expr
    value: Callable[[Mapping[str, Any]], Any] = field(compare=False, repr=False)  # of its names' values

    def __call__(self, **values: Any) -> Any:
        """Its value; arrays broadcast."""
        return self.value(values)

    def c(self, rename: Mapping[str, str] | None = None) -> str:
        """The same in C (math.h); `rename` gives the names there."""
        return _written(self.tree, "c", rename or {})

    def modelica(self, rename: Mapping[str, str] | None = None) -> str:
        """The same in Modelica."""
        return _written(self.tree, "modelica", rename or {})


def parse(text: str, known: Collection[str]) -> Expression:
    """Check a formula; `known` are the names that it may use.  Errors: `FormulaError`."""
    if len(text) > _LONGEST:
        raise FormulaError(f"formula {text[:40]!r}...: longer than {_LONGEST} characters")
    try:
        with _parsing:
            tree = ast.parse(text.strip(), mode="eval").body
        names = frozenset(_names(tree, text))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as problem:
        if isinstance(problem, FormulaError):
            raise
        raise FormulaError(f"formula {text!r}: not arithmetic") from None
    unknown = sorted(names - set(known))
    if unknown:
        raise FormulaError(f"formula {text!r}: {unknown[0]!r} is none of {', '.join(sorted(known))}")
    return Expression(text.strip(), names, tree, _calculation(tree))


def _is_number(value: int | float) -> bool:
    """Whether a constant of a formula is a finite double."""
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, bool) and abs(value) <= _MOST_INTEGER


def _names(node: ast.expr, text: str) -> set[str]:
    """Names used below a node; raises for anything that is no arithmetic."""
    match node:
        case ast.Constant(value=int() | float() as value) if _is_number(value):
            return set()
        case ast.Name(id=name):
            return {name}
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            return _names(operand, text)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            return _names(left, text) | _names(right, text)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
            if len(arguments) != FUNCTIONS[name].arity:
                raise FormulaError(f"formula {text!r}: {name} takes {FUNCTIONS[name].arity} arguments")
            return set().union(*(_names(argument, text) for argument in arguments))
    raise FormulaError(
        f"formula {text!r}: {ast.unparse(node)!r} is no arithmetic; functions are {', '.join(FUNCTIONS)}"
    )


def _calculation(node: ast.expr) -> Callable[[Mapping[str, Any]], Any]:
    """What a checked node calculates: built once, since a simulation asks for it at every step."""
    match node:
        case ast.Constant(value=value):
            number = float(value)  # type: ignore[arg-type]  # `parse` admits numbers alone
            return lambda values: number
        case ast.Name(id=name):
            return operator.itemgetter(name)
        case ast.UnaryOp(op=op, operand=operand):
            inner = _calculation(operand)
            return (lambda values: -inner(values)) if isinstance(op, ast.USub) else inner
        case ast.BinOp(left=left, op=ast.Pow(), right=ast.Constant(value=3)):
            return _cubed(_calculation(left))
        case ast.BinOp(left=left, op=op, right=right):
            return _of_two(_BINARY[type(op)][0], _calculation(left), _calculation(right))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            function, only = FUNCTIONS[name].numpy, _calculation(argument)
            return lambda values: function(only(values))
        case ast.Call(func=ast.Name(id=name), args=[first, second]):
            return _of_two(FUNCTIONS[name].numpy, _calculation(first), _calculation(second))
    raise AssertionError(ast.dump(node))  # `parse` admits nothing else


def _cubed(base: Callable[[Mapping[str, Any]], Any]) -> Callable[[Mapping[str, Any]], Any]:
    """The third power, twenty times as fast as NumPy's."""

    def calculated(values: Mapping[str, Any]) -> Any:
        number = base(values)
        return number * number * number

    return calculated


def _of_two(
    operation: Callable[[Any, Any], Any],
    left: Callable[[Mapping[str, Any]], Any],
    right: Callable[[Mapping[str, Any]], Any],
) -> Callable[[Mapping[str, Any]], Any]:
    return lambda values: operation(left(values), right(values))


def _written(node: ast.expr, language: str, rename: Mapping[str, str]) -> str:
    match node:
        case ast.Constant(value=value):
            return repr(float(value))  # type: ignore[arg-type]  # as above
        case ast.Name(id=name):
            return rename.get(name, name)
        case ast.UnaryOp(op=op, operand=operand):
            inner = _written(operand, language, rename)
            return f"(-{inner})" if isinstance(op, ast.USub) else inner
        case ast.BinOp(left=left, op=op, right=right):
            a, b = _written(left, language, rename), _written(right, language, rename)
            if isinstance(op, ast.Pow) and language == "c":
                return f"pow({a}, {b})"
            return f"({a} {_BINARY[type(op)][1]} {b})"
        case ast.Call(func=ast.Name(id=name), args=arguments):
            template = FUNCTIONS[name].c if language == "c" else FUNCTIONS[name].modelica
            return template.format(*(_written(argument, language, rename) for argument in arguments))
    raise AssertionError(ast.dump(node))
