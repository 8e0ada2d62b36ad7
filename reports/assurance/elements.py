"""Elements of an assurance case in the Goal Structuring Notation."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class ElementKind(StrEnum):
    """ElementKind of an element, with the prefix of its identifier."""

    GOAL = "G"
    STRATEGY = "S"
    SOLUTION = "Sn"
    CONTEXT = "C"
    ASSUMPTION = "A"
    DEFEATER = "D"


class GoalState(StrEnum):
    """GoalState of a goal, from the least to the most severe."""

    SUPPORTED = "supported"
    CHALLENGED = "supported, with open defeaters"
    OPEN = "not shown"
    REFUTED = "refuted"


@dataclass(frozen=True)
class Element:
    """An element of the case with the elements that support it, are its context, or challenge it.

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


def number_elements(root: Element) -> list[tuple[str, Element, str]]:
    """List the elements in the order of the argument with their identifiers, and those of their parents."""
    numbers = dict.fromkeys(ElementKind, 0)
    listed: list[tuple[str, Element, str]] = []

    def visit(element: Element, parent: str) -> None:
        numbers[element.kind] += 1
        name = f"{element.kind}{numbers[element.kind]}"
        listed.append((name, element, parent))
        for child in element.children:
            visit(child, name)

    visit(root, "")
    return listed
