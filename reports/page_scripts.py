"""Data and scripts that the page contains."""

import base64
import hashlib
import json
from typing import Any

from markupsafe import Markup


def script_hash(text: str) -> str:
    """Compute the hash of a script for the page's content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def embed_json(data: Any) -> Markup:
    """Convert data to JSON, escaped for a script element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704
