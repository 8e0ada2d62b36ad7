"""The command `marsyard`, also as ``python -m marsyard``."""

import sys


def main() -> None:
    """Run the command line; Ctrl-C prints one line, also while modules are imported."""
    try:
        from marsyard.cli.app import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
