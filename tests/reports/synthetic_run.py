"""Folders of synthetic runs of descents, with rows of known statistics, and subjects of reports."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.campaigns.store.products import pack_products, save_packed
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store
from marsyard.reports.section import Subject
from marsyard.reports.stored import StoredRun

VELOCITY: Mapping[str, Any] = {
    "id": "DIMES-VEL",
    "statement": "The horizontal velocity is known within 5 m/s.",
    "metric": "velocity_error_m_s",
    "bound": 5.0,
    "probability": 0.99,
    "confidence": 0.9,
    "population": "valid",
}
#: Minimum columns of a report.
MIN_COLUMNS = ["case", "outcome", "answered", "velocity_error_m_s"]
#: Type of the fixture `make_run`.
MakeRun = Callable[..., Path]


def make_rows(
    cases: int,
    *,
    answer_rate: float = 0.9,
    n_crashed: int = 0,
    error_scale: float = 1.0,
    terrains: int = 4,
    seed: int = 1,
) -> pd.DataFrame:
    """Return rows of a synthetic descent campaign; `error_scale` multiplies the errors.

    The standard deviation of the errors increases with the off-nadir angle: 0.5 m/s plus 1/30 m/s per degree.
    """
    rng = np.random.default_rng(seed)
    is_valid = rng.random(cases) < answer_rate
    outcome = np.where(is_valid, "VALID", rng.choice(["NO_TEMPLATE_AREA", "NO_VALID_TRACK", "IMU_MISMATCH"], cases))
    off_nadir = rng.uniform(0.0, 30.0, cases)
    error = rng.normal(0.0, error_scale * (0.5 + off_nadir[:, None] / 30.0), (cases, 2))
    error[~is_valid] = np.nan
    frame = pd.DataFrame(
        {
            "case": np.arange(cases),
            "outcome": outcome,
            "answered": is_valid,
            "velocity_error_m_s": np.hypot(*error.T),
            "velocity_error_x_m_s": error[:, 0],
            "velocity_error_y_m_s": error[:, 1],
            "terrain": rng.integers(0, terrains, cases),
            "sun_elevation_deg": rng.uniform(20.0, 60.0, cases),
            "horizontal_speed_m_s": rng.uniform(0.0, 30.0, cases),
            "altitude_1_m": rng.normal(2000.0, 20.0, cases),
            "off_nadir_max_deg": off_nadir,
            "attitude_rate_max_deg_s": rng.uniform(0.0, 60.0, cases),
            "image_hash": [f"{case:064x}" for case in range(cases)],
            "gl_backend": "osmesa",
            "gl_version": "Mesa 22.3.6 llvmpipe",
            "wall_time_s": rng.uniform(1.0, 2.0, cases),
            "cpu_time_s": rng.uniform(1.0, 2.0, cases),
            "error": "",
            "traceback": "",
        }
    )
    return _mark_crashed(frame, n_crashed)


def _mark_crashed(frame: pd.DataFrame, n_crashed: int) -> pd.DataFrame:
    """Replace the last `n_crashed` rows by crashed cases, which have only an error message."""
    if not n_crashed:
        return frame
    rows = frame.index[-n_crashed:]
    number_columns = frame.select_dtypes("number").columns.difference(["case", "wall_time_s", "cpu_time_s"])
    frame = frame.astype(dict.fromkeys(number_columns, "float64"))
    frame.loc[rows, number_columns] = np.nan
    frame.loc[rows, ["image_hash", "gl_backend", "gl_version"]] = None
    frame.loc[rows, "outcome"] = "CRASHED"
    frame.loc[rows, "answered"] = False
    frame.loc[rows, "error"] = "RuntimeError: the context is lost"
    frame.loc[rows, "traceback"] = 'Traceback (most recent call last):\n  File "x.py", line 1\nRuntimeError: lost'
    return frame


def make_subject(frame: pd.DataFrame, metric: str | None = None, bound: float | None = None, **record: Any) -> Subject:
    """Return the subject of a report on rows; `record` are the entries of the campaign's record."""
    return Subject(StoredRun(Path("run"), frame, frame, record, ()), metric, bound)


def synthetic_products(seed: int = 1) -> dict[str, Any]:
    """Return products of a synthetic DIMES case: textured images and two tracks per pair; one track is invalid."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:256, 0:1024]
    products: dict[str, Any] = {}
    for number in (1, 2, 3):
        ground = 1500 + 500 * np.sin(u / 70 + number) * np.cos(v / 23) + rng.normal(0, 120, u.shape)
        products[f"image_{number}"] = np.clip(ground, 0, 4095).astype(np.uint16)
    columns = ["pair", "template", "template_u", "template_v", "match_u", "match_v", "contrast", "peak", "peak_width"]
    columns += ["second_peak_ratio", "valid", "velocity_east_m_s", "velocity_north_m_s"]
    columns += ["ground_east_m", "ground_north_m", "failed_contrast", "failed_second_peak"]
    rows = []
    for pair in (0, 1):
        for template in (0, 1):
            template_u, template_v = rng.uniform(60, 200, 2)
            is_valid = float((pair, template) != (1, 1))
            rows.append([pair, template, template_u, template_v, template_u + 12, template_v - 9, 5e4, 0.93, 2.1])
            rows[-1] += [0.45, is_valid, 14.2, -8.8]
            rows[-1] += [5.0 * (template_u - 128), 5.0 * (128 - template_v), 0.0, 1.0 - is_valid]
            products[f"window_{pair}_{template}"] = rng.normal(1500, 300, (61, 61)).astype(np.float32)
            products[f"template_{pair}_{template}"] = rng.normal(1500, 300, (17, 17)).astype(np.float32)
            products[f"match_{pair}_{template}"] = np.array([33.4, 39.2])
        # nadir camera with 5 m per pixel; the field of view of the rectified camera is 1.5 times as wide.
        # Frame of the rectified image: west edge, north edge and lattice spacing, m
        lattice = np.stack(np.meshgrid(*(np.linspace(-64.0, 319.0, 17),) * 2), axis=-1)
        products |= {f"rectified_{pair}_{side}": lattice for side in (0, 1)}
        products[f"rectified_frame_{pair}"] = np.array([-64.0 - 128.0, 128.0 + 64.0, 383.0 / 16.0]) * 5.0
        products[f"gsd_{pair}"] = np.array([5.0])
    products |= {"tracks": np.array(rows), "tracks_columns": columns}
    return products | {"velocity_estimated_m_s": np.array([14.1, -8.9]), "velocity_true_m_s": np.array([14.6, -9.2])}


def synthetic_record(frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the content of `campaign.json` in the form that the engine writes."""
    definition = {
        "name": "dimes-synthetic",
        "scenario": "descent",
        "description": "Parachute descents over rough terrain: synthetic rows for tests of the report.",
        "cases": len(frame),
        "seed": 7,
        "dispersions": {
            "location.terrain": {"distribution": "integer", "low": 0, "high": 3, "source": "bank of four terrains"},
            "sun.elevation_deg": {"distribution": "uniform", "low": 20.0, "high": 60.0, "source": "landing season"},
            "descent.altitude_first_m": {"distribution": "normal", "mean": 2000.0, "sd": 20.0, "source": "paper, I"},
            "descent.horizontal_speed_m_s": {"distribution": "uniform", "low": 0.0, "high": 30.0, "source": "II.A"},
        },
        "requirements": list(requirements),
    }
    return {
        "schema": 1,
        "name": "dimes-synthetic",
        "state": "finished",
        "started_utc": "2025-01-01T00:00:00Z",
        "finished_utc": "2025-01-01T00:01:00Z",
        "cases": len(frame),
        "seed": 7,
        "jobs": 2,
        "requirements": list(requirements),
        "definition": definition,
        "showcase": 3,
        "versions": {"marsyard": "0.1.0", "numpy": "2.4.0", "scipy": "1.17.0"},
        "git_commit": "0123456789abcdef0123456789abcdef01234567",
        "environment": {"python": "3.11.7", "platform": "Linux", "processor": "synthetic"},
        "cases_finished": len(frame),
        "cases_crashed": 0,
        "sessions": [{"command": "run"}],
        "changes": [],
        "identity": {"definition": "a", "code": "b", "versions": {}, "inputs": {}},
    }


def write_table_with_seal(directory: Path, frame: pd.DataFrame) -> None:
    """Write rows as a table, and a store that knows the table but contains no rows, so that it is fast."""
    path = directory / "cases.parquet"
    frame.to_parquet(path)
    create_store(directory / ROWS_FILE, {})
    with RowStore(directory / ROWS_FILE) as store:
        store.record_table(hashlib.sha256(path.read_bytes()).hexdigest())


def write_run(
    directory: Path,
    frame: pd.DataFrame,
    requirements: Sequence[Mapping[str, Any]] = (VELOCITY,),
    *,
    products: Mapping[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """Write a run folder; `products` are stored for case 3, and `changes` replace entries of the record."""
    directory.mkdir(parents=True, exist_ok=True)
    write_table_with_seal(directory, frame)
    record = {**synthetic_record(frame, requirements), **changes}
    (directory / "campaign.json").write_text(json.dumps(record), encoding="utf-8")
    if products is not None:
        save_packed(directory / "cases" / "3", pack_products(products), {"case": 3})
    return directory
