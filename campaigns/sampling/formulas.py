"""Formulas in campaign files: arithmetic over parameters, and nothing else.

A formula is written in Python's notation, parsed by Python's own parser and worked out node by node: numbers, names of
parameters (``descent.altitude_first_m``, ``heights_m[1]``), ``+ - * / **``, and the functions and constants below. What
is not on these lists is refused when the file is read; nothing is ever handed to ``eval``.
"""

from __future__ import annotations

import ast
import math
import operator
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from marsyard.campaigns.errors import near_match

#: Longer ones belong into a scenario.
LONGEST = 300

_BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,  # no complex numbers, and no whole numbers of a million digits
}
_UNARY: Mapping[type[ast.unaryop], Callable[[float], float]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
#: Functions by name, with how many arguments they take: the fewest and the most.
_FUNCTIONS: Mapping[str, tuple[Callable[..., float], int, int]] = {
    **{name: (getattr(math, name), 1, 1) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos")},
    **{name: (getattr(math, name), 1, 1) for name in ("atan", "radians", "degrees", "floor", "ceil")},
    "abs": (abs, 1, 1),
    "atan2": (math.atan2, 2, 2),
    "hypot": (math.hypot, 2, 8),
    "min": (min, 2, 8),
    "max": (max, 2, 8),
}
_CONSTANTS: Mapping[str, float] = {"pi": math.pi}


@dataclass(frozen=True)
class Formula:
    """A formula as written, and the paths of the parameters that it names, each once."""

    text: str
    names: tuple[str, ...]
    _root: ast.expr

    def value(self, values: Mapping[str, Any]) -> float:
        """What the formula comes to.

        Parameters
        ----------
        values
            Numbers by the parameters' dotted paths, at least those that it names.

        Raises
        ------
        ValueError
            Where a parameter is no number, or the result is not finite.
        """
        numbers = {name: _number(self.text, name, values[name]) for name in self.names}
        try:
            found = float(_worked_out(self._root, numbers))
        except (ArithmeticError, ValueError) as error:
            raise ValueError(f"{self._where(numbers)}: {error}") from error
        if not math.isfinite(found):
            raise ValueError(f"{self._where(numbers)}: it comes to {found}")
        return found

    def _where(self, numbers: Mapping[str, float]) -> str:
        given = ", ".join(f"{name} = {value:.6g}" for name, value in numbers.items())
        return f"'{self.text}' has no value{' where ' if given else ''}{given}"


@lru_cache(maxsize=1024)
def formula(text: str) -> Formula:
    """Reads a formula.

    Raises
    ------
    ValueError
        Where it is none, or asks for what formulas do not have.
    """
    if len(text) > LONGEST:
        raise ValueError(f"a formula has at most {LONGEST} characters, not {len(text)}")
    try:
        with warnings.catch_warnings():  # the parser finds some texts only odd
            warnings.simplefilter("ignore")
            root = ast.parse(text.strip(), mode="eval").body
        names = dict.fromkeys(_names(root))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        said = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ValueError(f"'{text}' is neither a number nor a formula: {said}") from None
    return Formula(text, tuple(names), root)


def _names(node: ast.expr) -> list[str]:
    """Paths of the parameters below a node; ValueError where there is anything that formulas do not have."""
    match node:
        case ast.Constant(value=value) if type(value) in (int, float):
            return []
        case ast.Name() | ast.Attribute() | ast.Subscript():
            path = _path(node)
            return [] if path in _CONSTANTS else [path]
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY:
            return _names(inner)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            return _names(left) + _names(right)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _, fewest, most = _FUNCTIONS.get(name, (None, 0, 0))
            if not most:
                known = sorted(_FUNCTIONS)
                raise ValueError(f"unknown function '{name}'{near_match(name, known)}; allowed: {', '.join(known)}")
            if not fewest <= len(arguments) <= most:
                takes = str(fewest) if fewest == most else f"{fewest} to {most}"
                raise ValueError(f"{name} takes {takes} arguments, not {len(arguments)}")
            return [path for argument in arguments for path in _names(argument)]
    raise ValueError("allowed: numbers, names of parameters, + - * / **, parentheses and functions")


def _path(node: ast.expr) -> str:
    """The dotted path that a name stands for."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=table, attr=name):
            return f"{_path(table)}.{name}"
        case ast.Subscript(value=table, slice=ast.Constant(value=int(place))) if type(place) is int:
            return f"{_path(table)}.{place}"
    raise ValueError("a parameter is named as in wind.east_m_s or heights_m[1]")


def _worked_out(node: ast.expr, numbers: Mapping[str, float]) -> float:
    """The value of a node that `_names` has let pass."""
    match node:
        case ast.Constant(value=value):
            return float(value)  # type: ignore[arg-type]  # numbers alone came this far
        case ast.UnaryOp(op=op, operand=inner):
            return _UNARY[type(op)](_worked_out(inner, numbers))
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_worked_out(left, numbers), _worked_out(right, numbers))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return float(_FUNCTIONS[name][0](*(_worked_out(argument, numbers) for argument in arguments)))
    path = _path(node)
    return _CONSTANTS[path] if path in _CONSTANTS else numbers[path]


def _number(text: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"'{text}' reckons with {name}, which is {value!r} and no number")
    return float(value)
