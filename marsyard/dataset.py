"""Training data (`marsyard dataset`): images of a campaign with ground truth, as shards in the WebDataset format.

A shard is a tar file with all images of its cases. The files of an image have a common key: 16-bit image (`image.png`),
range (`range.npy`, m), normals (`normal.npy`, world axes), masks (`rocks.png`; for landings `hazard.png`: 0 safe,
1 hazard, 255 unknown), camera model (`cahvor`) and metadata (`json`). Two runs of the same campaign write
byte-identical shards. Existing shards are complete and are not written again; an interrupted command can be repeated.
"""

import io
import itertools
import json
import tarfile
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.identity import definition_hash
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.running.shared_inputs import plan_inputs
from marsyard.image_files import encode_image
from marsyard.scenarios.image_samples import ProvidesSamples
from marsyard.scenarios.systems import scenario, scenario_names
from marsyard.sim.camera import BODY_FRAME, write_cahvor

MANIFEST = "dataset.json"


def write_dataset(campaign: Campaign, folder: Path, cases_per_shard: int, jobs: int) -> list[Path]:
    """Write the shards that do not exist; return the paths of all shards.

    Raises CampaignError if the scenario provides no samples, or the folder is read-only or contains another data set.
    """
    if not isinstance(campaign.scenario, ProvidesSamples):
        name = campaign.definition.scenario
        allowed = ", ".join(name for name in scenario_names() if isinstance(scenario(name), ProvidesSamples))
        raise CampaignError(f"the scenario '{name}' provides no training samples; allowed: {allowed}")
    _write_manifest(campaign, folder, cases_per_shard)
    total = campaign.definition.total_cases
    starts = range(0, total, cases_per_shard)
    paths = [folder / f"shard-{number:06d}.tar" for number in range(len(starts))]
    shards = {
        path: range(start, min(start + cases_per_shard, total)) for path, start in zip(paths, starts, strict=True)
    }
    missing_shards = [(path, cases) for path, cases in shards.items() if not path.exists()]
    if missing_shards:
        from joblib import Parallel, delayed

        # build terrains once here; otherwise each worker process would build them
        _prepare_terrains(campaign, itertools.chain.from_iterable(cases for _, cases in missing_shards))
        Parallel(n_jobs=jobs)(delayed(_write_shard)(campaign, path, cases) for path, cases in missing_shards)
    return paths


def _prepare_terrains(campaign: Campaign, cases: Iterable[int]) -> None:
    """Build the terrains (shared inputs) of the cases that are not in the cache."""
    parameters = campaign.base_parameters()
    for number in plan_inputs(campaign, cases).to_prepare:
        campaign.scenario.prepare(parameters, number)


def _write_manifest(campaign: Campaign, folder: Path, cases_per_shard: int) -> None:
    """Write the manifest of the data set. Raises StoreError if the folder contains another data set."""
    definition = campaign.definition
    manifest = {
        "campaign": definition.name,
        "cases_per_shard": cases_per_shard,
        "definition_sha256": definition_hash(definition),
        "definition": definition.model_dump(mode="json"),
    }
    path = folder / MANIFEST
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            previous = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(previous, dict):
                raise ValueError("it is not the manifest of a data set")
            for key in ("definition_sha256", "cases_per_shard"):
                if previous.get(key) != manifest.get(key):
                    raise StoreError(f"{folder} contains another data set ({key} differs); choose another folder")
            return
        path.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} cannot be read or written: {error}") from error


def _write_shard(campaign: Campaign, path: Path, cases: range) -> None:
    """Write a shard to a temporary file, and rename it when it is complete."""
    partial_path = path.with_suffix(".part")
    with tarfile.open(partial_path, "w", format=tarfile.USTAR_FORMAT) as shard:
        for case in cases:
            for name, contents in _create_files(campaign, case):
                entry = tarfile.TarInfo(name)
                entry.size = len(contents)
                shard.addfile(entry, io.BytesIO(contents))
    partial_path.replace(path)


def _create_files(campaign: Campaign, case: int) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the contents of each file of a case."""
    scenario = campaign.scenario
    assert isinstance(scenario, ProvidesSamples)  # noqa: S101  (checked by `write_dataset`)
    draws = campaign.draws(case)
    for number, sample in enumerate(scenario.samples(campaign.parameters(case), campaign.streams(case))):
        key = f"{case:07d}-{number}"
        metadata = {
            "campaign": campaign.definition.name,
            "case": case,
            "image_index": number,
            "dispersed_parameters": draws,
        }
        # scale the counts to the full range of 16 bits
        yield f"{key}.image.png", _encode(sample.image * np.uint16(2 ** (16 - sample.bits)))
        yield f"{key}.range.npy", _encode(sample.range_m)
        yield f"{key}.normal.npy", _encode(sample.normal)
        yield f"{key}.rocks.png", _encode(sample.rocks)
        if sample.hazard is not None:
            yield f"{key}.hazard.png", _encode(sample.hazard)
        with tempfile.NamedTemporaryFile() as camera:
            write_cahvor(sample.camera, Path(camera.name), frame=BODY_FRAME)
            yield f"{key}.cahvor", Path(camera.name).read_bytes()
        yield f"{key}.json", json.dumps({**metadata, "bits": sample.bits, **sample.metadata}, indent=1).encode()


def _encode(values: np.ndarray[Any, Any]) -> bytes:
    """Encode integers as PNG, and other numbers as NPY."""
    if not np.issubdtype(values.dtype, np.integer):
        buffer = io.BytesIO()
        np.save(buffer, values, allow_pickle=False)
        return buffer.getvalue()
    return encode_image(".png", values)
