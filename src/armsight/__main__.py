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
    finally:
        # CPython ends `python -m` by the signal after an interrupt within an exec (of dataclasses), though it is caught
        exec("")


if __name__ == "__main__":
    main()
