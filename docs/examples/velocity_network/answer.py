"""Answer all exported cases with one process, in batches, and write the table of answers.

marsyard export dimes-smoke --out smoke
python -m velocity_network.answer smoke answers.csv --device cuda:0 --batch 16
marsyard score smoke answers.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from marsyard.algorithms.exchange import read_case
from velocity_network.estimator import NetworkEstimator


def main() -> None:
    """Read the cases of each batch, answer them, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path, help="folder of `marsyard export`")
    parser.add_argument("answers", type=Path, help="table for `marsyard score`")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=16, help="cases per call of the network")
    arguments = parser.parse_args()
    estimator = NetworkEstimator(device=arguments.device)
    folders = sorted((arguments.cases / "cases").iterdir())
    rows = []
    for start in range(0, len(folders), arguments.batch):
        batch = folders[start : start + arguments.batch]
        answers = estimator.estimate_batch([read_case(folder) for folder in batch])
        for folder, answer in zip(batch, answers, strict=True):
            east, north = (None, None) if answer.velocity_m_s is None else answer.velocity_m_s
            rows.append(
                {
                    "case": int(folder.name),
                    "outcome": answer.outcome.name,
                    "velocity_east_m_s": east,
                    "velocity_north_m_s": north,
                }
            )
    pd.DataFrame(rows).to_csv(arguments.answers, index=False)
    print(f"answered: {len(rows)} cases")


if __name__ == "__main__":
    main()
