"""XML camera files: detection, root element and parsing."""

import re
from xml.etree import ElementTree

from marsyard.sim.camera.source import Source

#: Start of an XML file, and the first element: an optional declaration, comments, and a name with an optional prefix.
_XML_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*<(\?xml|!--|!DOCTYPE|[A-Za-z_][\w:.-]*[\s>/])")
_XML_ROOT = re.compile(rb"<(?:[A-Za-z_][\w.-]*:)?(?P<root>[A-Za-z_][\w.-]*)")
_XML_PROLOGUE = re.compile(rb"<\?.*?\?>|<!--.*?-->", re.DOTALL)


def is_xml(head: bytes) -> bool:
    """Return whether the first bytes of a file are XML."""
    return _XML_START.match(head) is not None


def xml_root(head: bytes) -> str:
    """Return the name of the first element in the first bytes of an XML file; empty if there is none."""
    match = _XML_ROOT.search(_XML_PROLOGUE.sub(b"", head))
    return "" if match is None else match["root"].decode()


def parse_xml(source: Source, allowed: str) -> ElementTree.Element:
    """Parse an XML file. Raises CameraFileError; `allowed` describes the file."""
    text = source.read_text()
    if "<!ENTITY" in text:  # camera files do not need entities, and nested entities can fill the memory
        raise source.error("label", "declares entities", f"{allowed}, which has none")
    try:
        return ElementTree.fromstring(text.encode("latin-1"))  # noqa: S314  (entities are refused above)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise source.error("label", f"cannot be parsed ({error})", f"{allowed}, which is XML") from error
