"""Time limit of the search for effects, and what the end of a diagnosis omitted."""

from __future__ import annotations

import math
from collections.abc import Callable

from carlab.core.clock import Clock, MonotonicClock
from carlab.core.errors import ConfigError
from carlab.diagnosis.findings import SearchExtent
from carlab.diagnosis.settings import DEFAULT


class SearchTimer:
    """Ends the search for effects when its time is over, and remembers whether it was cut short.

    Args:
        budget_s: time limit of a diagnosis without measured curves, networks and adaptation [s]; None for no limit.
        stop: callback of the user; true ends the search.
        search_share: share of the time limit after which the search ends; the rest is for checks and the report.
        clock: clock of the limit, which begins now.

    Raises:
        ConfigError: the limit is not a time above 0 s.
    """

    def __init__(
        self,
        budget_s: float | None,
        stop: Callable[[], bool] = lambda: False,
        search_share: float = DEFAULT.selection.search_time_share,
        clock: Clock | None = None,
    ) -> None:
        if budget_s is not None and not budget_s > 0.0:
            raise ConfigError(f"--budget {budget_s:g}: give a time above 0 s, or inf for no limit.")
        self.budget_s = budget_s
        self._stop = stop
        self._clock = clock or MonotonicClock()
        self._began_s = self._clock.now_s()
        self._end_s = None if budget_s is None else self._began_s + search_share * budget_s
        self._stopped_by = ""
        self._omitted: list[str] = []

    def ends_search(self) -> bool:
        """Whether the search must end. The search calls this only while it has more to do."""
        if not self._stopped_by:
            if self._stop():
                self._stopped_by = "user"
            elif self._end_s is not None and self._clock.now_s() >= self._end_s:
                self._stopped_by = "budget"
        return bool(self._stopped_by)

    def end_checks(self) -> None:
        """Remember that the user ended the checks after the search, which then skip the rest of their fits."""
        if not self._stopped_by and self._stop():
            self._stopped_by = "user"

    def omit(self, stage: str) -> None:
        """Remember that the user ended a requested stage without a result."""
        self._omitted.append(stage)

    def progress(self, shown: Callable[[str, float], None]) -> Callable[[str, float], None]:
        """The progress callback ``shown`` with the remaining time of the search behind the activity."""

        def with_time(activity: str, share: float) -> None:
            left_s = math.inf if self._end_s is None else self._end_s - self._clock.now_s()
            shown(f"{activity} (at most {left_s:.0f} s left)" if 0.0 < left_s < math.inf else activity, share)

        return with_time

    def elapsed_s(self) -> float:
        """Time since the beginning [s]."""
        return self._clock.now_s() - self._began_s

    def extent(self) -> SearchExtent:
        """Whether the search was complete, what ended it, and the stages without a result."""
        limit_s = None if self.budget_s == math.inf else self.budget_s
        return SearchExtent(not self._stopped_by, self._stopped_by, limit_s, omitted=tuple(self._omitted))
