"""The report states faults of the recording that look like physics: limited commands."""

from carlab.diagnosis.findings import DataFault
from tests.diagnosis.report_material import changed, unexplained_physics

LIMITED = DataFault("limited_commands", "steering", 900, "reported: the log or the radio limits the command.")


def test_limited_commands_replace_the_class_of_missing_physics() -> None:
    limited = changed(unexplained_physics(), data_faults=(LIMITED,))
    assert "Class of the missing physics" in unexplained_physics().sentence
    assert "Class of the missing physics" not in limited.sentence
    assert "The log or the radio limits the steering." in limited.sentence
    assert limited.advice.startswith("Record again with a log of the commands that the car executes")
