"""Short names of algorithms and scores: the prefixes of their columns."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path


def labels(specs: Sequence[str]) -> tuple[str, ...]:
    """Return unique short names of algorithms, the prefixes of their columns.

    >>> labels(["dimes", "phase-correlation", "mypkg.velocity:Estimator", "exec:./mine --fast", "exec:./mine"])
    ('dimes', 'phase_correlation', 'Estimator', 'mine', 'mine_2')
    """
    unique_labels: list[str] = []
    for spec in specs:
        program = re.match(r"(?:(?:exec|serve)(?:-stream)?|answers|export):\s*(\S+)", spec)
        basename = Path(program[1]).stem if program else spec.rpartition(":")[2]
        label = re.sub(r"\W", "_", basename, flags=re.ASCII)
        # names of columns must begin with a letter
        label = label if label[:1].isalpha() else f"a_{label}"
        candidates = itertools.chain([label], (f"{label}_{number}" for number in itertools.count(2)))
        unique_labels.append(next(name for name in candidates if name not in unique_labels))
    return tuple(unique_labels)
