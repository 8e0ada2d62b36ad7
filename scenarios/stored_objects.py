"""Algorithms given as Python objects: stored with cloudpickle, and named ``FILE.pkl:Name``.

Worker processes and later replays load the object from the file. An object of an importable class is stored by its
import path and state; a class or function of a notebook is stored with its code.
"""

import copy
import dis
import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

#: Ending of a stored object.
SUFFIX = ".pkl"
#: Digits of the hash in the name of a stored object.
_HASH_DIGITS = 12


class StoredInstance:
    """Factory that returns copies of an instance, so that no case changes the algorithm of the next case."""

    def __init__(self, instance: Any) -> None:
        self.instance = instance
        self.version = getattr(instance, "version", None)
        self.options = getattr(instance, "options", None)

    def __call__(self) -> Any:
        """Return a copy of the instance."""
        return copy.deepcopy(self.instance)


class FunctionEstimator:
    """Estimator whose method `estimate` is a function of the measurements."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.estimate = function
        self.__name__ = function.__name__


def store_object(value: Any, folder: Path) -> str:
    """Store an algorithm that is given as an object in `folder`, if necessary, and return its specification.

    - a text is returned unchanged
    - a class, or a function without parameters, is called once in each worker process
    - a function of the measurements is the method `estimate` of an estimator
    - any other object is an algorithm itself; each worker process receives a copy

    Raises ValueError if the object cannot be stored, for example because it holds an open file.
    """
    if isinstance(value, str):
        return value
    import cloudpickle  # here and below, so that `marsyard list` starts fast

    if inspect.isfunction(value) and _has_required_parameters(value):
        stored: Any = StoredInstance(FunctionEstimator(value))
    elif isinstance(value, type) or inspect.isfunction(value):
        if _is_importable(value):
            return f"{value.__module__}:{value.__qualname__}"
        stored = value
    else:
        stored = StoredInstance(value)
    name = "".join(letter if letter.isalnum() else "_" for letter in _object_name(value))
    source = _read_source(value)
    try:
        contents = cloudpickle.dumps(stored)
        # with `__slots__`, unlike `vars`
        state = b"" if isinstance(value, type) else cloudpickle.dumps(value.__getstate__())
        captured = _captured_values(value)
        state += cloudpickle.dumps(captured) if captured else b""
    except Exception as error:  # objects of users may raise anything
        raise ValueError(f"the algorithm {name} cannot be stored: {type(error).__name__}: {error}") from error
    # the bytes of a class of a notebook differ between sessions; its source, the state of an instance and the captured
    # values do not
    digest = hashlib.sha256(source.encode() + state if source else contents).hexdigest()[:_HASH_DIGITS]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder.resolve() / f"{name}-{digest}{SUFFIX}"
    path.write_bytes(contents)
    path.with_suffix(".py").write_text(source, encoding="utf-8")
    return f"{path}:{name}"


def load_object(path: str) -> Any:
    """Load a stored class, function or factory. Raises ImportError with the reason."""
    import cloudpickle

    try:
        return cloudpickle.loads(Path(path).read_bytes())
    except Exception as error:  # the modules of the object may raise anything
        raise ImportError(f"{path}: {type(error).__name__}: {error}") from error


def _object_name(value: Any) -> str:
    return str(getattr(value, "__name__", type(value).__name__)).strip("<>")


def _read_source(value: Any) -> str:
    """Return the source code of a class or function, or of the class of an object; empty if it is not known."""
    target = value if isinstance(value, type) or inspect.isfunction(value) else type(value)
    with suppress(OSError, TypeError):
        return inspect.getsource(target)
    return ""


def _captured_values(value: Any, known: frozenset[int] = frozenset()) -> list[Any]:
    """List the values that the code of an object takes from outside: bases, attributes, defaults, closures and globals.

    The code is that of a function, or of a class or of the class of an object. Two functions or classes with the same
    source are different algorithms if these values differ. A class or function among them is represented by its name
    and source, and by its own captured values. Code that worker processes import is stored without values.
    """
    code = value if isinstance(value, type) or inspect.isfunction(value) else type(value)
    if id(code) in known or _is_importable(code):
        return []
    members = [code] if inspect.isfunction(code) else _class_members(code)
    functions = [item for item in members if inspect.isfunction(item)]
    captured: list[Any] = []
    outside_values = [item for item in members if not inspect.isfunction(item)]
    for item in (*outside_values, *(item for function in functions for item in _outside_values(function))):
        if isinstance(item, type) or inspect.isfunction(item):
            source = "" if _is_importable(item) else _read_source(item)
            captured += [(item.__module__, item.__qualname__, source), *_captured_values(item, known | {id(code)})]
        elif not inspect.ismodule(item):
            captured.append(item)
    return captured


def _class_members(owner: type) -> list[Any]:
    """List the bases, the functions and the values of the attributes of a class, without those of its bases."""
    members: list[Any] = [base for base in owner.__bases__ if base is not object]
    for name, item in vars(owner).items():
        accessors: list[Any] = [item.fget, item.fset, item.fdel] if isinstance(item, property) else [item]
        # those of static and class methods, and below decorators
        functions = [inspect.unwrap(getattr(accessor, "__func__", accessor)) for accessor in accessors]
        if any(map(inspect.isfunction, functions)):
            members += filter(inspect.isfunction, functions)
        elif not name.startswith(("__", "_abc_")) and not hasattr(type(item), "__get__"):
            members.append(item)
    return members


def _outside_values(function: FunctionType) -> list[Any]:
    """List the defaults, the closure and the global variables of a function; names that have no value are omitted."""
    values = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # the variable has no value yet
            values.append(cell.cell_contents)
    names = sorted(set(_global_names(function.__code__)))
    return values + [function.__globals__[name] for name in names if name in function.__globals__]


def _global_names(code: CodeType) -> Iterator[str]:
    """Yield the names of global variables in a function's code, and in the functions and classes inside."""
    for item in dis.get_instructions(code):
        if item.opname in ("LOAD_GLOBAL", "LOAD_NAME"):  # the latter in the bodies of classes
            yield item.argval
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _global_names(constant)


def _has_required_parameters(function: Callable[..., Any]) -> bool:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = inspect.signature(function).parameters.values()
    return any(item.kind in kinds and item.default is inspect.Parameter.empty for item in parameters)


def _is_importable(value: Any) -> bool:
    """Whether worker processes can import a class or function by module and name."""
    module = sys.modules.get(value.__module__)
    is_top_level = "." not in value.__qualname__ and getattr(module, value.__qualname__, None) is value
    return is_top_level and value.__module__ != "__main__" and getattr(module, "__file__", None) is not None
