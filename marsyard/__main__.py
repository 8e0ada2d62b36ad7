"""``python -m marsyard``: the same as the command ``marsyard``."""

from __future__ import annotations

from marsyard.cli.app import main

if __name__ == "__main__":
    main()
