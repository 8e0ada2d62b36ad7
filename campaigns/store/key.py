"""Key of this user, with which Marsyard signs what it wrote itself: origins, rows, tables and reports."""

import hashlib
import hmac
import os
import secrets
import tempfile
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from marsyard.campaigns.errors import report_write_errors


def sign(*contents: bytes) -> str:
    """Compute a hash of contents with the key of this user. Raises StoreError if the key cannot be created or read."""
    digests = b"".join(hashlib.sha256(content).digest() for content in contents)
    return hmac.new(_read_key(_key_path()), digests, hashlib.sha256).hexdigest()


def is_signature(signature: str, *contents: bytes) -> bool:
    """Whether a text is the signature of contents by this user; False if the user has no key."""
    # a record can contain lone surrogates
    text = signature.encode(errors="surrogatepass")
    return _key_path().exists() and hmac.compare_digest(text, sign(*contents).encode())


def _key_path() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "marsyard" / "origin.key"


@lru_cache(maxsize=4)
def _read_key(path: Path) -> bytes:
    """Return the key of this user; it is created at its first use."""
    with report_write_errors(path):
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.NamedTemporaryFile(dir=path.parent) as file:
                file.write(secrets.token_bytes(32))
                file.flush()
                with suppress(FileExistsError):  # another process has created it
                    os.link(file.name, path)
        return path.read_bytes()
