"""``python -m armsight``: the command line."""

from armsight.app.main import main

if __name__ == "__main__":
    main()
