"""Base class of the dispersions, types of their fields, formulas, and quantiles of truncated distributions.

A dispersion defines the distribution of a parameter over the cases by its inverse distribution function, which maps one
uniform number to a value. The uniform numbers can be independent, correlated or stratified. The parameters of a
distribution can be formulas of other parameters of the campaign; `Dispersion.insert_values` evaluates the formulas.
"""

import ast
import math
import operator
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, PlainValidator
from pydantic_core import PydanticKnownError
from scipy.special import ndtr, ndtri

from marsyard.campaigns.errors import suggest_similar
from marsyard.sim.parameters import Parameters

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
#: Functions by name, with the minimum and maximum number of arguments.
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
            _, minimum, maximum = _FUNCTIONS.get(name, (None, 0, 0))
            if not maximum:
                allowed = sorted(_FUNCTIONS)
                raise ValueError(
                    f"unknown function '{name}'{suggest_similar(name, allowed)}; allowed: {', '.join(allowed)}"
                )
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
            return float(_FUNCTIONS[name][0](*(_evaluate(argument, numbers) for argument in arguments)))
    path = _format_path(node)
    return _CONSTANTS[path] if path in _CONSTANTS else numbers[path]


#: Probability of each tail that is ignored when a distribution is compared with the allowed range of a parameter.
TAIL = 1e-12


class Dispersion(Parameters, ABC):
    """Base class of the dispersions.

    By default, `unit` and `description` are those of the parameter: the suffix of its name, and its description in the
    scenario.
    """

    #: Whether the distribution has a density; only then can its ranks be correlated.
    continuous: ClassVar[bool] = False
    #: Fields that contain texts or literal values, never formulas.
    _literals: ClassVar[set[str]] = {"distribution", "unit", "description", "source", "values", "value"}

    unit: str | None = None
    description: str | None = None
    source: str = ""

    @abstractmethod
    def quantile(self, probability: float) -> Any:
        """Return the quantile of the distribution at a probability, 0 < probability < 1."""

    def bounds(self) -> tuple[float, float] | None:
        """Return the range of all values, infinite if unbounded; None if values are no numbers or use formulas."""
        return None

    def extremes(self) -> tuple[Any, ...]:
        """Return the values that are compared with the allowed range of the parameter."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    @cached_property
    def formulas(self) -> Mapping[tuple[str | int, ...], Formula]:
        """Formulas in the fields of the dispersion, by their keys."""
        return dict(_find_formulas(self.model_dump(mode="json", exclude=self._literals)))

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the parameters on which the distribution depends, each once."""
        return tuple(dict.fromkeys(name for item in self.formulas.values() for name in item.names))

    def insert_values(self, values: Mapping[str, Any]) -> Self:
        """Evaluate the formulas for parameter values by path, and return the resulting distribution.

        Raises ValueError if a formula is undefined, limits are in the wrong order, or a width is not positive.
        """
        if not self.formulas:
            return self
        fields = self.model_dump(mode="json")
        for key, expression in self.formulas.items():
            table: Any = fields
            for part in key[:-1]:
                table = table[part]
            table[key[-1]] = expression.evaluate(values)
        return type(self).model_validate(fields)

    def describe(self) -> str:
        """Describe the distribution and its parameters in one line."""
        fields = self.model_dump(exclude={"distribution", "unit", "description", "source"}, exclude_none=True)
        texts = []
        for name, value in fields.items():
            text = str(value)
            if isinstance(value, list | tuple):
                values_text = ", ".join(str(item) for item in value)
                is_short = len(value) <= 2 or len(values_text) <= 60
                text = f"[{values_text}]" if is_short else f"[{value[0]}, ... {len(value)} in all]"
            texts.append(f"{name}={text}")
        return f"{getattr(self, 'distribution', '?')}({', '.join(texts)})"


def _find_formulas(tree: Any, key: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Formula]]:
    """Yield the formulas in nested tables and lists, with their keys."""
    if isinstance(tree, str):
        yield key, parse_formula(tree)
        return
    inner = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, list) else ()
    for part, value in inner:
        yield from _find_formulas(value, (*key, part))


def _check_number(value: Any) -> float | str:
    """Return a finite number, or the text of a formula."""
    if isinstance(value, str):
        return parse_formula(value).text
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PydanticKnownError("float_type")
    if not abs(value) < math.inf:
        raise PydanticKnownError("finite_number")
    try:
        return float(value)
    except OverflowError:
        raise PydanticKnownError("finite_number") from None


def _check_positive_number(value: Any) -> float | str:
    """Return a positive number, or the text of a formula."""
    number = _check_number(value)
    if isinstance(number, float) and not number > 0.0:
        raise PydanticKnownError("greater_than", {"gt": 0})
    return number


def _check_whole_number(value: Any) -> int | str:
    """Return an integer that a float represents exactly, or the text of a formula."""
    if isinstance(value, str):
        return parse_formula(value).text
    if type(value) is not int:
        raise PydanticKnownError("int_type")
    if abs(value) > 2**52:
        raise ValueError(f"must lie between -2**52 and 2**52, got {value}")
    return value


def _check_literal(value: Any) -> Any:
    """Return a value in which all numbers are finite, because result files cannot store other numbers."""
    items = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    for inner in items:
        _check_literal(inner)
    if isinstance(value, float) and not math.isfinite(value):
        raise PydanticKnownError("finite_number")
    return value


Number = Annotated[float | str, PlainValidator(_check_number)]
PositiveNumber = Annotated[float | str, PlainValidator(_check_positive_number)]
Limits = tuple[Number, Number]
WholeNumber = Annotated[int | str, PlainValidator(_check_whole_number)]
LiteralValue = Annotated[Any, PlainValidator(_check_literal)]
Weight = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]


def read_interval(low: float | str, high: float | str) -> tuple[float, float] | None:
    """Convert limits to numbers; None if one of them is a formula."""
    return None if isinstance(low, str) or isinstance(high, str) else (float(low), float(high))


@dataclass(frozen=True, eq=False)
class UnivariateDistribution:
    """A distribution of one variable.

    - evaluate: evaluates `cdf`, `sf` (survival function), or the inverse functions `ppf` and `isf`, by name
    - support: minimum and maximum
    """

    evaluate: Callable[[str, float], float]
    support: tuple[float, float] = (-math.inf, math.inf)
    is_discrete: bool = False


_NORMAL_FUNCTIONS: Mapping[str, Callable[[float], Any]] = {
    "cdf": ndtr,
    "sf": lambda x: ndtr(-x),
    "ppf": ndtri,
    "isf": lambda q: -ndtri(q),
}
#: Standard normal distribution, without `scipy.stats`, whose import takes a second.
STANDARD_NORMAL = UnivariateDistribution(lambda function, x: float(_NORMAL_FUNCTIONS[function](x)))


@lru_cache(maxsize=1)
def scipy_distributions() -> Mapping[str, bool]:
    """Return the univariate distributions of `scipy.stats` by name, and whether each is discrete.

    `uniform` is excluded, since `Uniform` has other parameters.
    """
    from scipy import stats

    kinds = ((name, getattr(stats, name)) for name in dir(stats) if name != "uniform")
    accepted = (stats.rv_continuous, stats.rv_discrete)
    return {name: isinstance(kind, stats.rv_discrete) for name, kind in kinds if isinstance(kind, accepted)}


def scipy_parameters(distribution: str) -> tuple[list[str], list[str]]:
    """Return the parameters that a distribution of `scipy.stats` requires, and all parameters that it accepts."""
    from scipy import stats

    shapes = getattr(stats, distribution).shapes
    required = [name.strip() for name in shapes.split(",")] if shapes else []
    return required, [*required, "loc"] if scipy_distributions()[distribution] else [*required, "loc", "scale"]


def create_scipy_distribution(distribution: str, parameters: Mapping[str, float]) -> UnivariateDistribution:
    """Create a distribution of `scipy.stats` with parameters.

    Raises ValueError if the distribution is not defined for the parameters; its evaluation can raise it as well.
    """
    from scipy import stats

    failure = f"{distribution} is not defined for {', '.join(f'{key} = {value}' for key, value in parameters.items())}"

    def call_without_warnings(function: Callable[[], Any]) -> Any:
        # SciPy's warnings are not needed, since invalid results are recognized as NaN
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return function()
        except (ArithmeticError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{failure}: {error}") from error

    def evaluate(function: str, x: float) -> float:
        result = call_without_warnings(lambda: float(getattr(scipy_distribution, function)(x)))
        if math.isnan(result):
            raise ValueError(f"{failure}: its {function} at {x} is not a number")
        return float(result)

    scipy_distribution = call_without_warnings(lambda: getattr(stats, distribution)(**parameters))
    low, high = call_without_warnings(lambda: [float(limit) for limit in scipy_distribution.support()])
    if not low <= high:
        raise ValueError(failure)
    return UnivariateDistribution(evaluate, (low, high), scipy_distributions()[distribution])


def truncated_quantile(
    distribution: UnivariateDistribution, limits: tuple[float, float] | None, probability: float
) -> float | int:
    """Compute a quantile of a distribution F, truncated to `limits` [a, b] if they are defined.

    The quantile at p is F^-1(F(a) + p (F(b) - F(a))). If a exceeds the median, the survival function replaces F, since
    1 - F would lose digits of small values. The limits of discrete distributions are included.

    Raises ValueError if the limits are in the wrong order or the probability between them is zero.
    """
    low, high = distribution.support if limits is None else limits
    if limits is None:
        value = distribution.evaluate("ppf", probability)
    else:
        inverse, at_low, at_high = _find_truncated_inverse(distribution, low, high)
        value = distribution.evaluate(inverse, at_low + probability * (at_high - at_low))
    value = min(max(value, low), high)
    if distribution.is_discrete and not math.isfinite(value):
        raise ValueError(f"the distribution includes {value}")
    return round(value) if distribution.is_discrete else value


@lru_cache(maxsize=1024)
def _find_truncated_inverse(distribution: UnivariateDistribution, low: float, high: float) -> tuple[str, float, float]:
    """Return the name of the inverse function with the higher precision, and its arguments at the two limits."""
    if not (low <= high if distribution.is_discrete else low < high):
        raise ValueError(f"truncate = [{low}, {high}]: the first limit must be below the second")
    # the lower limit of a discrete distribution is included: F is evaluated at the previous integer
    low_argument = math.ceil(low) - 1.0 if distribution.is_discrete else low
    function, inverse = ("sf", "isf") if distribution.evaluate("cdf", low_argument) > 0.5 else ("cdf", "ppf")
    at_low, at_high = distribution.evaluate(function, low_argument), distribution.evaluate(function, high)
    if not abs(at_high - at_low) > 0.0:
        raise ValueError(f"truncate = [{low}, {high}]: the distribution has no probability between the limits")
    return inverse, at_low, at_high
