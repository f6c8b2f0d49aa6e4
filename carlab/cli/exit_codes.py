"""Exit codes of ``carlab`` that several verbs use."""

EXIT_FAILED = 1
EXIT_SAFETY_STOP = 4
EXIT_INCONCLUSIVE = 5
"""As ``carlab.diagnosis.recordings.Inconclusive.exit_code``: no verdict."""
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""As a shell reports the signal SIGPIPE (128 + 13)."""
