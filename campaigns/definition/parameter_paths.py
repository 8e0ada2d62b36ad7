"""Values in nested tables and lists, addressed by dotted paths such as `wind.east_m_s` or `heights_m.1`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def replace_values(tree: Any, values: Mapping[str, Any]) -> Any:
    """Copy nested tables and lists with new values at dotted paths."""
    for path, value in values.items():
        tree = replace_value(tree, path.split("."), value)
    return tree


def replace_value(tree: Any, path: Sequence[str], value: Any) -> Any:
    """Copy nested tables and lists with a new value at one path."""
    if not path:
        return value
    key, *subpath = path
    if isinstance(tree, list):
        index = int(key)
        return [*tree[:index], replace_value(tree[index], subpath, value), *tree[index + 1 :]]
    return {**tree, key: replace_value(tree[key], subpath, value)}


def value_at(tree: Any, path: str) -> Any:
    """Return the value at a dotted path in nested tables and lists. Raises ValueError if there is no such path."""
    node = tree
    for part in path.split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"there is no parameter '{path}'") from None
    return node


def find_value(tree: Any, path: str) -> Any:
    """Return the value at a dotted path in nested tables and lists; `()` if there is no such path."""
    try:
        return value_at(tree, path)
    except ValueError:
        return ()


def paths_overlap(first: str, second: str) -> bool:
    """Whether two dotted paths are equal, or one of them leads to a table or list that contains the other.

    >>> paths_overlap("wind", "wind.east_m_s"), paths_overlap("wind", "winds")
    (True, False)
    """
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value in nested tables and lists with its dotted path."""
    if isinstance(tree, Mapping):
        for name, inner in tree.items():
            yield from leaves(inner, f"{path}.{name}" if path else str(name))
    elif isinstance(tree, list) and tree:
        for index, inner in enumerate(tree):
            yield from leaves(inner, f"{path}.{index}")
    else:
        yield path, tree
