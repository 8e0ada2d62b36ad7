"""The documentation's site: ``make docs`` builds it into build/docs, with every warning an error."""

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

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
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


def setup(app: Sphinx) -> None:
    """Writes the generated pages and figures; shows diagrams, which GitHub draws, as they are written."""
    write_pages()
    draw_figures(Path(__file__).parent / "generated")
    app.add_lexer("mermaid", TextLexer)
