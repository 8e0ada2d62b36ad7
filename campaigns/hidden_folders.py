"""Removal of the user's folders from text that is shared."""

import os
import re


def hide_folders(text: str) -> str:
    """Replace the cache folder of this user by ``$MARSYARD_CACHE`` and the home folder by ``~``, for files to share."""
    for name, folder in (("$MARSYARD_CACHE", os.environ.get("MARSYARD_CACHE", "")), ("~", os.environ.get("HOME", ""))):
        if len(folder.rstrip("/")) > 1 and folder.rstrip("/") in text:
            # a path ends at a character that no name contains; it is no part of another path or of base64 text
            text = re.sub(rf"(?<![\w+.~-]){re.escape(folder.rstrip('/'))}(?![\w+.-])", name, text)
    return text
