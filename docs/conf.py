"""Sphinx configuration of the documentation; ``make docs`` builds the site in build/docs, with warnings as errors."""

import re
import sys
from importlib import metadata
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))
from figures import draw_figures
from pages import write_pages

project = "Marsyard"
author = "the Marsyard developers"
release = metadata.version("marsyard")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["examples", "images"]
# an attribute name that exists in several classes is ambiguous in text; Sphinx warns about it
suppress_warnings = ["ref.python"]
source_suffix = {".md": "markdown"}

myst_heading_anchors = 3
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
python_use_unqualified_type_names = True

# `name` in a docstring is the name of a Python object
default_role = "py:obj"

html_theme = "furo"
html_title = f"Marsyard {release}"
html_show_copyright = False


def split_attributes(_app: Sphinx, _what: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    """Split entries of several attributes with one description into one entry per attribute, as Napoleon does.

    In ``:ivar first, second: ...``, Sphinx would interpret ``first,`` as the type of ``second``.
    """
    split_lines: list[str] = []
    names: list[str] = []
    description: list[str] = []
    for line in [*lines, ""]:
        entry = re.match(r":ivar ([^:]*,[^:]*):(.*)", line)
        if names and line.strip() and line[0].isspace():
            description.append(line)
            continue
        for name in names:
            split_lines += [f":ivar {name}:{description[0]}", *description[1:]]
        names = [name.strip() for name in entry[1].split(",")] if entry else []
        description = [entry[2]] if entry else []
        if not entry:
            split_lines.append(line)
    lines[:] = split_lines[:-1]


def setup(app: Sphinx) -> None:
    """Write the generated pages and figures. Diagrams in Mermaid, which GitHub draws, are shown as source text."""
    # after Napoleon, which has Sphinx's default priority of 500
    app.connect("autodoc-process-docstring", split_attributes, priority=600)
    write_pages()
    draw_figures(Path(__file__).parent / "generated")
    app.add_lexer("mermaid", TextLexer)
