"""Argument of an assurance case in the Goal Structuring Notation: its elements, and their drawing as SVG."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from html import escape
from typing import NamedTuple


class ElementKind(StrEnum):
    """Kind of an element, with the prefix of its identifier."""

    GOAL = "G"
    STRATEGY = "S"
    SOLUTION = "Sn"
    CONTEXT = "C"
    ASSUMPTION = "A"
    DEFEATER = "D"


class GoalState(StrEnum):
    """State of a goal, from the least to the most severe."""

    SUPPORTED = "supported"
    CHALLENGED = "supported, with open defeaters"
    OPEN = "not shown"
    REFUTED = "refuted"


@dataclass(frozen=True)
class Element:
    """An element of the argument with the elements that support it, are its context, or challenge it.

    - evidence: file of the package, relative to its folder; empty without one
    - own_state: state that the evidence of the element determines; the state of a goal is the worst below it
    """

    kind: ElementKind
    text: str
    children: tuple[Element, ...] = ()
    evidence: str = ""
    own_state: GoalState = GoalState.SUPPORTED

    @property
    def state(self) -> GoalState:
        """The worst state of this element and those below; an open defeater challenges all goals above it."""
        order = list(GoalState)
        return max((self.own_state, *(child.state for child in self.children)), key=order.index)


def goal(text: str, *children: Element | None) -> Element:
    """Create a goal with the elements that exist."""
    return Element(ElementKind.GOAL, text, tuple(child for child in children if child is not None))


def defeater(text: str, evidence: str = "", state: GoalState = GoalState.CHALLENGED) -> Element:
    """Create an open defeater."""
    return Element(ElementKind.DEFEATER, text, evidence=evidence, own_state=state)


class NumberedElement(NamedTuple):
    """An element with its identifier (`G1`, for example) and that of its parent; empty for the root."""

    name: str
    element: Element
    parent: str


def number_elements(root: Element) -> list[NumberedElement]:
    """List the elements in the order of the argument with their identifiers."""
    numbers = dict.fromkeys(ElementKind, 0)
    listed: list[NumberedElement] = []

    def visit(element: Element, parent: str) -> None:
        numbers[element.kind] += 1
        name = f"{element.kind}{numbers[element.kind]}"
        listed.append(NumberedElement(name, element, parent))
        for child in element.children:
            visit(child, name)

    visit(root, "")
    return listed


#: SVG dash pattern of the box of a defeater.
_DASHES = 'stroke-dasharray="6 3"'
#: Width of a box, gaps between columns and rows, height of a line of text, margin around the text, pixels.
_WIDTH, _COLUMN_GAP, _ROW_GAP, _LINE, _PAD = 300.0, 56.0, 12.0, 15.0, 11.0
#: Slant of a strategy's box, maximum radius of a solution's ends, radius of a context's corners, pixels.
_SLANT, _END_RADIUS, _CORNER_RADIUS = 14.0, 30.0, 12.0
#: Left margin of the text, and height of the first line above its lower edge, pixels; maximum characters of a line.
_TEXT_LEFT, _ASCENT, _CHARACTERS = 20.0, 11.0, 44
#: Colours of the states, readable on white; the state is also written in each box.
_COLOURS: Mapping[GoalState, str] = {
    GoalState.SUPPORTED: "#1c7c5c",
    GoalState.CHALLENGED: "#9c6a00",
    GoalState.OPEN: "#5a6672",
    GoalState.REFUTED: "#b3261e",
}


@dataclass(frozen=True)
class _Box:
    """An element at a position: identifier, lines of text, column, y of its top, and the boxes of its children."""

    name: str
    element: Element
    lines: tuple[str, ...]
    column: int
    top: float
    children: tuple[_Box, ...]

    @property
    def height(self) -> float:
        return _LINE * len(self.lines) + 2 * _PAD

    @property
    def left(self) -> float:
        return self.column * (_WIDTH + _COLUMN_GAP) + _PAD

    @property
    def middle(self) -> float:
        return self.top + 0.5 * self.height

    @property
    def bottom(self) -> float:
        """Lower end of the box and of those below it."""
        return max([self.top + self.height, *(child.bottom for child in self.children)])

    def walk(self) -> Iterator[_Box]:
        yield self
        for child in self.children:
            yield from child.walk()


def draw_argument(root: Element) -> str:
    """Draw the argument as an SVG document."""
    box = _place(root, 0, _PAD, iter([item.name for item in number_elements(root)]))
    boxes = list(box.walk())
    width = max(item.left for item in boxes) + _WIDTH + _PAD
    height = max(item.top + item.height for item in boxes) + _PAD
    parts = [_draw_link(parent, child) for parent in boxes for child in parent.children]
    parts += [_draw_box(item) for item in boxes]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}" role="img" aria-label="Assurance case" font-family="sans-serif" font-size="12">\n'
        '<defs><marker id="end" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#5a6672"/></marker></defs>\n'
        f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def _place(element: Element, column: int, top: float, names: Iterator[str]) -> _Box:
    """Place an element below `top`, and its children in the next column; a parent is centred on its children.

    names: identifiers in the order of the argument (`number_elements`)
    """
    name, children, next_top = next(names), [], top
    lines = [f"{name} {element.kind.name.lower()}: {element.state}" if element.kind is ElementKind.GOAL else name]
    lines += textwrap.wrap(element.text, _CHARACTERS)
    for child in element.children:
        children.append(_place(child, column + 1, next_top, names))
        next_top = children[-1].bottom + _ROW_GAP
    height = _LINE * len(lines) + 2 * _PAD
    middle = 0.5 * (children[0].middle + children[-1].middle) if children else 0.0
    own_top = max(top, middle - 0.5 * height) if children else top
    return _Box(name, element, tuple(lines), column, own_top, tuple(children))


def _draw_link(parent: _Box, child: _Box) -> str:
    """Draw a link: solid for support, dashed for context, red towards the parent for a challenge."""
    start, end, bend = parent.left + _WIDTH, child.left, 0.5 * _COLUMN_GAP
    kind = child.element.kind
    style = 'stroke="#5a6672" marker-end="url(#end)"'
    controls = f"{start + bend:g} {parent.middle:g} {end - bend:g} {child.middle:g}"
    path = f"M{start:g} {parent.middle:g}C{controls} {end:g} {child.middle:g}"
    if kind in (ElementKind.CONTEXT, ElementKind.ASSUMPTION):
        style = 'stroke="#5a6672" stroke-dasharray="4 3"'
    elif kind is ElementKind.DEFEATER:
        style = 'stroke="#b3261e" stroke-dasharray="2 2"'
    return f'<path d="{path}" fill="none" {style}/>'


def _draw_box(box: _Box) -> str:
    """Draw shape and text of an element; an element with evidence is a link to its file."""
    x, y, w, h = box.left, box.top, _WIDTH, box.height
    kind, colour = box.element.kind, _COLOURS[box.element.state]
    style = f'fill="#fff" stroke="{colour}" stroke-width="1.6"'
    right = x + w
    slanted = f"M{x + _SLANT:g} {y:g}H{right:g}L{right - _SLANT:g} {y + h:g}H{x:g}z"
    shapes = {
        ElementKind.STRATEGY: f'<path d="{slanted}" {style}/>',
        ElementKind.DEFEATER: f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" {style} {_DASHES}/>',
    }
    radius = {
        ElementKind.SOLUTION: min(0.5 * h, _END_RADIUS),
        ElementKind.CONTEXT: _CORNER_RADIUS,
        ElementKind.ASSUMPTION: min(0.5 * h, _END_RADIUS),
    }.get(kind, 0.0)
    rectangle = f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="{radius:g}" {style}/>'
    weights = [" font-weight='bold'", *[""] * (len(box.lines) - 1)]
    text = "".join(
        f'<tspan x="{x + _TEXT_LEFT:g}" y="{y + _PAD + _ASCENT + _LINE * index:g}"{weight}>{escape(line)}</tspan>'
        for index, (line, weight) in enumerate(zip(box.lines, weights, strict=True))
    )
    content = f'{shapes.get(kind, rectangle)}<text fill="#10161d">{text}</text>'
    evidence = escape(box.element.evidence, quote=True)
    return f'<a href="{evidence}">{content}</a>' if evidence else f"<g>{content}</g>"
