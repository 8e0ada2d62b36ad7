"""The documentation's site: ``make docs`` builds it into build/docs, with every warning an error."""

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
# attributes of one name in several classes, named in the text by that name alone
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

# `name` in a docstring is a thing of the code
default_role = "py:obj"

html_theme = "furo"
html_title = f"Marsyard {release}"
html_show_copyright = False


def split_attributes(_app: Sphinx, _what: str, _name: str, _thing: object, _options: object, lines: list[str]) -> None:
    """Give each of several attributes that share a description an entry of its own, as Napoleon does with parameters.

    Without that, Sphinx takes all but the last of ``:ivar first, second: ...`` for the type of the last.
    """
    split: list[str] = []
    names: list[str] = []
    described: list[str] = []
    for line in [*lines, ""]:
        begins = re.match(r":ivar ([^:]*,[^:]*):(.*)", line)
        if names and line.strip() and line[0].isspace():
            described.append(line)
            continue
        for one in names:
            split += [f":ivar {one}:{described[0]}", *described[1:]]
        names = [one.strip() for one in begins[1].split(",")] if begins else []
        described = [begins[2]] if begins else []
        if not begins:
            split.append(line)
    lines[:] = split[:-1]


def setup(app: Sphinx) -> None:
    """Writes the generated pages and figures; shows diagrams, which GitHub draws, as they are written."""
    # after Napoleon, which has Sphinx's usual priority of 500
    app.connect("autodoc-process-docstring", split_attributes, priority=600)
    write_pages()
    draw_figures(Path(__file__).parent / "generated")
    app.add_lexer("mermaid", TextLexer)
