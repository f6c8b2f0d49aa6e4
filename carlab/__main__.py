"""``python -m carlab`` is the ``carlab`` command."""

from carlab.cli import main

if __name__ == "__main__":
    main()
