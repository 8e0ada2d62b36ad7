"""Makes the fake scenario importable, here and in worker processes; and what writes folders of real pictures, here."""

from __future__ import annotations

import os
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
HERE = str(TESTS / "campaigns")
if HERE not in sys.path:
    sys.path.append(HERE)
    os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), HERE])
sys.path.append(str(TESTS / "scenarios" / "measured"))
