"""Formulas of other parameters, as values of the parameters of a distribution."""

import ast
import math
import operator
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from marsyard.campaigns.errors import suggest_similar

#: Maximum number of characters of a formula.
MAX_FORMULA_LENGTH = 300
_BINARY_OPERATORS: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,  # unlike **, it results in no complex numbers and no integers of a million digits
}
_UNARY_OPERATORS: Mapping[type[ast.unaryop], Callable[[float], float]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}


class _Function(NamedTuple):
    """A function of formulas, with its minimum and maximum number of arguments."""

    call: Callable[..., float]
    min_arguments: int = 1
    max_arguments: int = 1


#: Functions by name.
_FUNCTIONS: Mapping[str, _Function] = {
    **{name: _Function(getattr(math, name)) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos")},
    **{name: _Function(getattr(math, name)) for name in ("atan", "radians", "degrees", "floor", "ceil")},
    "abs": _Function(abs),
    "atan2": _Function(math.atan2, 2, 2),
    "hypot": _Function(math.hypot, 2, 8),
    "min": _Function(min, 2, 8),
    "max": _Function(max, 2, 8),
}
_CONSTANTS: Mapping[str, float] = {"pi": math.pi}


@dataclass(frozen=True)
class Formula:
    """A parsed formula: its text, and the paths of the parameters in it, each once."""

    text: str
    names: tuple[str, ...]
    _root: ast.expr

    def evaluate(self, values: Mapping[str, Any]) -> float:
        """Evaluate the formula for parameter values by dotted path.

        Raises ValueError if a parameter is not a number, or the result is not finite.
        """
        numbers: dict[str, float] = {}
        for name in self.names:
            value = values[name]
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"'{self.text}' uses {name}, which is {value!r} and not a number")
            numbers[name] = float(value)
        inputs = ", ".join(f"{name} = {value:.6g}" for name, value in numbers.items())
        failure = f"'{self.text}' is undefined{' for ' if inputs else ''}{inputs}"
        try:
            result = float(_evaluate(self._root, numbers))
        except (ArithmeticError, ValueError) as error:
            raise ValueError(f"{failure}: {error}") from error
        if not math.isfinite(result):
            raise ValueError(f"{failure}: the result is {result}")
        return result


@lru_cache(maxsize=1024)
def parse_formula(text: str) -> Formula:
    """Parse a formula. Raises ValueError if the text is not a formula."""
    if len(text) > MAX_FORMULA_LENGTH:
        raise ValueError(f"a formula has at most {MAX_FORMULA_LENGTH} characters, not {len(text)}")
    try:
        with warnings.catch_warnings():  # ignore warnings of the parser about invalid syntax
            warnings.simplefilter("ignore")
            root = ast.parse(text.strip(), mode="eval").body
        names = dict.fromkeys(_list_names(root))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ValueError(f"'{text}' is neither a number nor a formula: {reason}") from None
    return Formula(text, tuple(names), root)


def _list_names(node: ast.expr) -> list[str]:
    """List the paths of the parameters below a node. Raises ValueError for syntax that formulas do not support."""
    match node:
        case ast.Constant(value=value) if type(value) in (int, float):
            return []
        case ast.Name() | ast.Attribute() | ast.Subscript():
            path = _format_path(node)
            return [] if path in _CONSTANTS else [path]
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY_OPERATORS:
            return _list_names(inner)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY_OPERATORS:
            return _list_names(left) + _list_names(right)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            if name not in _FUNCTIONS:
                allowed = sorted(_FUNCTIONS)
                raise ValueError(
                    f"unknown function '{name}'{suggest_similar(name, allowed)}; allowed: {', '.join(allowed)}"
                )
            _, minimum, maximum = _FUNCTIONS[name]
            if not minimum <= len(arguments) <= maximum:
                accepted_numbers = str(minimum) if minimum == maximum else f"{minimum} to {maximum}"
                raise ValueError(f"{name} takes {accepted_numbers} arguments, not {len(arguments)}")
            return [path for argument in arguments for path in _list_names(argument)]
    raise ValueError("allowed: numbers, names of parameters, + - * / **, parentheses and functions")


def _format_path(node: ast.expr) -> str:
    """Return the dotted path of a parameter name. Raises ValueError for other syntax."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=table, attr=name):
            return f"{_format_path(table)}.{name}"
        case ast.Subscript(value=table, slice=ast.Constant(value=int(index))) if type(index) is int:
            return f"{_format_path(table)}.{index}"
    raise ValueError("a parameter name has the form wind.east_m_s or heights_m[1]")


def _evaluate(node: ast.expr, numbers: Mapping[str, float]) -> float:
    """Evaluate a syntax tree that `_list_names` accepted."""
    match node:
        case ast.Constant(value=value):
            return float(value)  # type: ignore[arg-type]  # `_list_names` accepts numbers only
        case ast.UnaryOp(op=op, operand=inner):
            return _UNARY_OPERATORS[type(op)](_evaluate(inner, numbers))
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY_OPERATORS[type(op)](_evaluate(left, numbers), _evaluate(right, numbers))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return float(_FUNCTIONS[name].call(*(_evaluate(argument, numbers) for argument in arguments)))
    path = _format_path(node)
    return _CONSTANTS[path] if path in _CONSTANTS else numbers[path]
