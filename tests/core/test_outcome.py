"""Sentences of the end of an episode."""

import pytest

from carlab.core.outcome import EndReason
from carlab.core.safety import SafetyStop


@pytest.mark.parametrize(
    ("detail", "ending"),
    [
        ("", "then start again."),
        ("the VESC reports under-voltage.", "then start again. The VESC reports under-voltage."),
        ("/dev/ttyACM0 was lost.", "then start again. /dev/ttyACM0 was lost."),
    ],
)
def test_detail_is_a_sentence_of_its_own(detail: str, ending: str) -> None:
    assert EndReason.ACTUATOR_FAULT.sentences(detail).endswith(ending)
    assert str(SafetyStop(EndReason.ACTUATOR_FAULT, detail)).endswith(ending)
