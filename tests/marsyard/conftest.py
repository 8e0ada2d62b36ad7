"""Makes the fake scenario importable, here and in worker processes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = str(Path(__file__).resolve().parents[1] / "campaigns")
if HERE not in sys.path:
    sys.path.append(HERE)
    os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), HERE])
