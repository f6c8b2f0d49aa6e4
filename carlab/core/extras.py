"""Optional packages of carlab, which ``pip install -e '.[NAME]'`` installs in a clone of the repository."""

from __future__ import annotations


def install_hint(extra: str) -> str:
    """How to install an extra. The package ``carlab`` of the Python Package Index is another project."""
    return f"in the repository of carlab, run: .venv/bin/pip install -c constraints.txt -e '.[{extra}]'"
