"""The banner states what a real car gets, also where no policy drives it."""

import pytest

from carlab.cli.console import banner, console
from carlab.core.quantities import Reality


@pytest.mark.parametrize(
    ("reality", "moves", "sentence"),
    [
        (Reality.REAL, True, "A REAL CAR WILL MOVE"),
        (Reality.REAL, False, "it gets neutral only, which centres its servo"),
        (Reality.DRY_RUN, True, "the car gets neutral only, which centres its servo"),
    ],
)
def test_banner_does_not_hide_that_neutral_turns_the_servo(reality: Reality, moves: bool, sentence: str) -> None:
    with console.capture() as capture:
        banner(reality, "blue car", moves=moves)
    assert sentence in " ".join(capture.get().split())
