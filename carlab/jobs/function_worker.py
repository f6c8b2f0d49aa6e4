"""The program of a child process of ``FunctionWorkers``: makes the calls of its parent."""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection

from carlab.jobs.function_workers import serve

if __name__ == "__main__":
    with Connection(int(sys.argv[1])) as connection:
        try:
            serve(connection)
        except Exception:  # the parent makes the call again, and reports its error
            sys.exit(1)
