"""Every error that carlab raises on purpose.

    CarlabError
    ├── ConfigError (ValueError)         a file or option is wrong: names the key and the nearest known one
    ├── DataError (ValueError)           a recording or packet is wrong: names the row, the column or the byte
    │   ├── DivergedError                numbers of what is learned grew beyond all bounds
    │   └── ProtocolError                bytes that do not follow their protocol
    ├── NotReadyError (ConnectionError)  a car, port or camera system is not there; lists every reason at once
    ├── NotOpenError (RuntimeError)      used before open() or after close()
    ├── NotArmedError (RuntimeError)     a moving command before arm()
    ├── ActionOutOfRangeError (ValueError)  a command beyond the car's limits, or not a number
    ├── PoseLostError (TimeoutError)     no pose, or one that is too old
    ├── ActuatorFaultError (OSError)     the link, the firmware or the sender process failed; latched
    └── SafetyStop                       the safety gate ended the episode (beside the gate, in carlab.core.safety)

Each message is one sentence with the next step. The command line prints it alone and exits with ``exit_code``.
"""

from __future__ import annotations

from collections.abc import Sequence


class CarlabError(Exception):
    """Base of all errors raised on purpose. ``exit_code`` is what the command line returns."""

    exit_code = 1


class ConfigError(CarlabError, ValueError):
    """A configuration file or an option is wrong."""

    exit_code = 2


class DataError(CarlabError, ValueError):
    """A recording or a packet cannot be used as it is."""


class DivergedError(DataError):
    """What was being learned is no number any more; with smaller steps or other draws it may go well."""


class ProtocolError(DataError):
    """Bytes that do not follow their protocol."""


class NotReadyError(CarlabError, ConnectionError):
    """Something that must be there is not. Holds every reason found, not only the first."""

    exit_code = 3

    def __init__(self, what: str, reasons: Sequence[str] = ()) -> None:
        self.what = what
        self.reasons = tuple(reasons)
        if len(self.reasons) == 1:
            message = f"{what}: {self.reasons[0]}"
        else:
            message = what + "".join(f"\n  - {reason}" for reason in self.reasons)
        super().__init__(message)


class NotOpenError(CarlabError, RuntimeError):
    """A car or device was used before open() or after close()."""


class NotArmedError(CarlabError, RuntimeError):
    """A command other than neutral was given to a car that is not armed."""

    exit_code = 4


class ActionOutOfRangeError(CarlabError, ValueError):
    """A command is not a number or lies beyond the car's limits."""

    exit_code = 4


class PoseLostError(CarlabError, TimeoutError):
    """Motion capture delivers no usable pose."""

    exit_code = 4


class ActuatorFaultError(CarlabError, OSError):
    """The actuator link, its firmware or the sender process failed. Latched until reset."""

    exit_code = 4
