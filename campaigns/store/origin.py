"""Origin of a campaign's folder: whether this user's installation created it.

A folder can name code of its author: a custom scenario, algorithm or part. Commands that run cases execute it only if
the record contains a hash with the key of this user, or after `adopt` (option ``--trust``). The rows of a folder that
this user created must also be signed by this user.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.components import list_algorithms, list_parts
from marsyard.campaigns.definition.identity import custom_sources, hash_sources, stored_definition_hash
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.store import record
from marsyard.campaigns.store.key import is_signature, sign
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, readable_store
from marsyard.scenarios.imports import search_current_folder
from marsyard.scenarios.offline_algorithms import is_offline

#: Keys of a definition that can name code.
_KEYS = {"scenario", "parameters", "dispersions"}


def describe_origin(definition: CampaignDefinition) -> dict[str, Any]:
    """Create the origin for the record of a new campaign: hashes of the code that it names, and the signature."""
    names = [*([definition.scenario] if ":" in definition.scenario else []), *_list_names(definition)]
    return {"code": _hash_code(names), "signature": _sign(definition)}


def check_origin(directory: Path, definition: CampaignDefinition) -> None:
    """Raise CampaignError if a folder that was created elsewhere names code; nothing is executed."""
    names = _list_code(definition)
    if names and not _is_own(directory, definition):
        raise CampaignError(
            f"{directory} was created or changed elsewhere, and this command would execute code that it names: "
            f"{', '.join(names)}. Nothing was executed. If you trust this code: --trust"
        )


def check_rows(directory: Path) -> str:
    """Verify the rows of a campaign; return the reason if there is only their table, otherwise an empty text.

    Raises StoreError if a row was changed after it was stored, the rows are those of another definition, or rows of a
    folder of this user are not signed by it.
    """
    path = directory / ROWS_FILE
    if not path.exists():
        return f"{directory} has no {ROWS_FILE}"
    with readable_store(path) as store:
        store.verify()
        is_signed, identity = store.is_signed, store.about.get("identity")
    _check_definition(directory, identity)
    if not is_signed and _is_own_folder(directory):
        raise StoreError(
            f"{path} was written by another user or program than {record.RECORD_FILE}, which you created: its rows may "
            f"not be those of its cases. If you trust them: marsyard report {directory} --trust"
        )
    return ""


def _check_definition(directory: Path, identity: str | None) -> None:
    """Raise StoreError if the definition in the record is not the one with which the rows were stored.

    identity: hash in the first head of the chain. A campaign that was continued with another definition lists this
    change in its record, and cannot be PASS.
    """
    try:
        stored = record.read(directory)
    except StoreError:  # rows without a valid record
        return
    if identity and identity != stored_definition_hash(stored["definition"]) and not stored["changes"]:
        raise StoreError(
            f"{directory / record.RECORD_FILE}: the definition is not the one with which the rows were stored"
        )


def adopt(directory: Path) -> None:
    """Accept a folder that was created elsewhere. Raises CampaignError if its code is not the recorded one."""
    definition, origin = record.stored_definition(directory), _read_origin(directory)
    recorded = origin.get("code")
    names = dict(recorded) if isinstance(recorded, dict) else {}
    changed = [name for name, digest in _hash_code(list(names)).items() if digest != names[name]]
    if changed or not names.keys() >= set(_list_code(definition)):
        raise CampaignError(
            f"--trust: the code here is not the code that {directory} recorded: {', '.join(changed) or 'none'}"
        )
    if (directory / ROWS_FILE).exists():
        with RowStore(directory / ROWS_FILE) as store:
            store.verify()
            store.sign()
    record.update(directory, {"origin": {**origin, "signature": _sign(definition)}})


def _list_code(definition: CampaignDefinition) -> list[str]:
    """List all code that a definition names; only a custom scenario knows which of its parameters name code."""
    return [definition.scenario] if ":" in definition.scenario else _list_names(definition)


def _is_own_folder(directory: Path) -> bool:
    """Whether this user created a folder; False if its record is damaged."""
    try:
        return _is_own(directory, record.stored_definition(directory))
    except StoreError:
        return False


def _is_own(directory: Path, definition: CampaignDefinition) -> bool:
    """Whether this user created or adopted a folder with a definition."""
    return is_signature(str(_read_origin(directory).get("signature")), _signed_content(definition))


def _list_names(definition: CampaignDefinition) -> list[str]:
    """List the algorithms and parts that are not installed: ``module:name``, ``FILE.pkl:name`` and programs."""
    names = (*list_algorithms(definition), *list_parts(definition))
    return [name for name in names if ":" in name and not name.startswith("marsyard.") and not is_offline(name)]


def _hash_code(names: Sequence[str]) -> dict[str, str]:
    """Compute the hash of the sources of each name, without importing them."""
    search_current_folder()
    return {name: hash_sources(custom_sources(name)) for name in names}


def _read_origin(directory: Path) -> dict[str, Any]:
    origin = record.read(directory).get("origin")
    return origin if isinstance(origin, dict) else {}


def _sign(definition: CampaignDefinition) -> str:
    return sign(_signed_content(definition))


def _signed_content(definition: CampaignDefinition) -> bytes:
    """Return everything in a definition that can name code."""
    return json.dumps(definition.model_dump(mode="json", include=_KEYS), sort_keys=True).encode()
