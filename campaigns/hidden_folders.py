"""Removal of the user's folders from text that is shared."""

import os
import re


def hide_folders(text: str) -> str:
    """Replace the cache folder of this user by ``$MARSYARD_CACHE`` and the home folder by ``~``, for files to share."""
    for name, variable in (("$MARSYARD_CACHE", "MARSYARD_CACHE"), ("~", "HOME")):
        folder = os.environ.get(variable, "").rstrip("/")
        if len(folder) > 1 and folder in text:
            # a path ends at a character that no name contains, or at the full stop of a sentence; it is no part of
            # another path or of base64 text
            text = re.sub(rf"(?<![\w+.~-]){re.escape(folder)}(?!\.*[\w+-])", name, text)
    return text
