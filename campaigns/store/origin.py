"""Origin of a campaign's folder: whether this user's installation created it.

A folder can name code of its author: a custom scenario, algorithm or part. Commands that run cases execute it only if
the record contains a hash with the key of this user, or after `adopt` (option ``--trust``).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.definition.identity import custom_sources, hash_sources, list_algorithms, list_parts
from marsyard.campaigns.errors import CampaignError, report_write_errors
from marsyard.campaigns.store import record
from marsyard.scenarios.imports import search_current_folder
from marsyard.scenarios.offline import is_offline

#: Keys of a configuration that can name code.
_KEYS = {"scenario", "parameters", "dispersions"}


def describe_origin(configuration: CampaignConfiguration) -> dict[str, Any]:
    """Create the origin for the record of a new campaign: hashes of the code that it names, and the signature."""
    names = [*([configuration.scenario] if ":" in configuration.scenario else []), *_list_names(configuration)]
    return {"code": _hash_code(names), "signature": _sign(configuration)}


def check_origin(directory: Path, configuration: CampaignConfiguration) -> None:
    """Raise CampaignError if a folder that was created elsewhere names code; nothing is executed."""
    # only a custom scenario knows which of its parameters name code
    names = [configuration.scenario] if ":" in configuration.scenario else _list_names(configuration)
    signature = str(_read_origin(directory).get("signature"))
    if names and not hmac.compare_digest(signature.encode(), _sign(configuration).encode()):
        raise CampaignError(
            f"{directory} was created or changed elsewhere, and this command would execute code that it names: "
            f"{', '.join(names)}. Nothing was executed. If you trust this code: --trust"
        )


def adopt(directory: Path) -> None:
    """Accept a folder that was created elsewhere. Raises CampaignError if its code is not the recorded one."""
    configuration, origin = record.stored_configuration(directory), _read_origin(directory)
    recorded = origin.get("code")
    names = dict(recorded) if isinstance(recorded, dict) else {}
    changed = [name for name, digest in _hash_code(list(names)).items() if digest != names[name]]
    if changed or not names:
        raise CampaignError(
            f"--trust: the code here is not the code that {directory} recorded: {', '.join(changed) or 'none'}"
        )
    record.update(directory, {"origin": {**origin, "signature": _sign(configuration)}})


def _list_names(configuration: CampaignConfiguration) -> list[str]:
    """List the algorithms and parts that are not installed: ``module:name``, ``FILE.pkl:name`` and programs."""
    names = (*list_algorithms(configuration), *list_parts(configuration))
    return [name for name in names if ":" in name and not name.startswith("marsyard.") and not is_offline(name)]


def _hash_code(names: Sequence[str]) -> dict[str, str]:
    """Compute the hash of the sources of each name, without importing them."""
    search_current_folder()
    return {name: hash_sources(custom_sources(name)) for name in names}


def _read_origin(directory: Path) -> dict[str, Any]:
    origin = record.read(directory).get("origin")
    return origin if isinstance(origin, dict) else {}


def _sign(configuration: CampaignConfiguration) -> str:
    """Compute the hash of everything in a configuration that can name code, with the key of this user."""
    contents = configuration.model_dump(mode="json", include=_KEYS)
    return sign(json.dumps(contents, sort_keys=True).encode())


def sign(*contents: bytes) -> str:
    """Compute a hash of contents with the key of this user. Raises StoreError if the key cannot be created or read."""
    digests = b"".join(hashlib.sha256(content).digest() for content in contents)
    return hmac.new(_read_key(), digests, hashlib.sha256).hexdigest()


def _read_key() -> bytes:
    """Return the key of this user; it is created at its first use."""
    path = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "marsyard" / "origin.key"
    with report_write_errors(path):
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.NamedTemporaryFile(dir=path.parent) as file:
                file.write(secrets.token_bytes(32))
                file.flush()
                with suppress(FileExistsError):  # another process has created it
                    os.link(file.name, path)
        return path.read_bytes()
