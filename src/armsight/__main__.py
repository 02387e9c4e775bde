"""``python -m armsight`` and ``armsight``: the command line."""

import sys


def main() -> None:
    """Run the command line; an interrupt while it is imported ends as a later one does, with exit code 130."""
    try:
        from armsight.app.main import main as run

        run()
    except KeyboardInterrupt:
        print("armsight: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
