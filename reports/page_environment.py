"""Environment of the templates of all pages (report, dashboard, gallery of sites), and data embedded in them."""

import base64
import hashlib
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

#: Class of the elements of a report's page with lists of cases, from which the dashboard takes excerpts.
LISTS_CLASS = "lists"
#: Beginning of the identifier of a case's element in a report's page; the case number follows. Also in `explorer.js`.
CASE_ANCHOR = "case-"


def status_class(word: object) -> str:
    """Return the name of the style of a verdict; a PASS with a qualification has that of MET BY RATE.

    >>> [status_class(word) for word in ("PASS", "PASS (unregistered)", "NO REQUIREMENT")]
    ['pass', 'met-by-rate', 'no-requirement']
    """
    text = str(word)
    return "met-by-rate" if text.startswith("PASS (") else text.lower().replace(" ", "-")


@cache
def page_environment() -> Environment:
    """Create a Jinja environment that escapes all values; its filter `code` marks words in backticks as code."""
    environment = Environment(
        autoescape=True,
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        lstrip_blocks=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters["status_class"] = status_class
    environment.filters["code"] = lambda text: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))  # noqa: S704
    environment.globals |= {"LISTS_CLASS": LISTS_CLASS, "CASE_ANCHOR": CASE_ANCHOR}
    return environment


def script_hash(text: str) -> str:
    """Compute the hash of a script for the page's content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def embed_json(data: Any) -> Markup:
    """Convert data to JSON, escaped for a script element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704
