"""Times of the link to the cluster."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Times of the link to the cluster.

    An answer is a file that arrived, or the state of a running training; a new connection is none.

    Attributes:
        wait_s: time without an answer after which a training runs on this computer [s]; a training takes about a
            minute.
        connect_s: time for a connection [s]; Ray takes 10 to 20 s, and longer on a busy cluster.
        lost_wait_s: the same for a cluster that did not answer the last time [s], so that a run without a cluster is
            delayed little; a connection takes 5 to 10 s.
        message_s: time without an answer after which the run prints that it waits [s]; longer than a connection takes.
        reconnect_s: time without an answer after which an open connection is opened again [s], because a dead link
            gives no error; longer than the transfer of one file takes.
        pause_s: pause before a refused connection is tried again [s].
        poll_s: time between two questions for the state of the training [s].
        max_lost_workers: lost workers of one training after which it runs on this computer; a training that needs too
            much memory loses every worker.
        idle_s: time without a question after which the training service ends on the cluster [s], so that a computer
            that disappeared leaves no process there.
    """

    wait_s: float = 120.0
    connect_s: float = 60.0
    lost_wait_s: float = 30.0
    message_s: float = 15.0
    reconnect_s: float = 30.0
    pause_s: float = 2.0
    poll_s: float = 0.5
    max_lost_workers: int = 3
    idle_s: float = 900.0
