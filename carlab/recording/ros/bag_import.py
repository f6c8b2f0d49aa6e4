"""Import of a ROS bag: its messages become a table with one row for each message, and values are held between them."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import ColumnMapping, ColumnSource
from carlab.recording.csv.foreign import ImportedRecording, import_table
from carlab.recording.csv.table import ColumnTable
from carlab.recording.ros.bag import Bag, Topic, opened_bag
from carlab.recording.ros.fields import FieldPath, MissingElementError, Sample, field_path, sample

TIME = "t"
"""Column with the times of the messages [s since 1970]."""
MAX_CLOCK_DIFFERENCE_S = 0.5
"""[s] Headers whose stamps differ more from the times of reception have another clock, such as simulated time."""
MAX_LISTED_TOPICS = 30
USED, NO_ELEMENT, NOT_FINITE = "are used", "lack the chosen element", "have a number that is not finite"
"""What happens to messages; clauses of sentences."""


def import_bag(path: Path | str, *, mapping: ColumnMapping | None) -> ImportedRecording:
    """Import a ROS bag as ``import_table`` does. Each pose has the newest command before it.

    The columns of the mapping are fields of topics, such as ``/drive/drive/steering_angle`` (``ros.fields``).

    Raises:
        ConfigError: the library rosbags is missing, there is no mapping, or it does not fit bags.
        DataError: the bag cannot be read, a topic or a field is missing, or ``import_table`` refuses the table.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        if mapping is None:
            raise ConfigError(
                f"{path.name} is a ROS bag with {_listed(bag.topics)}; convert it with carlab import --mapping "
                'FILE.toml, which names its fields, for example x = "/car/pose/pose/position/x" below [columns].'
            )
        if TIME in mapping.columns or mapping.rate_hz is not None:
            raise ConfigError("The times of a ROS bag are those of its messages; remove t and the rate.")
        rows = _rows_of(bag, _field_paths(bag, mapping))
    times_s, note = _message_times(path, rows, mapping)
    order = np.argsort(times_s, kind="stable")
    numbers = dict(zip(rows.columns, rows.numbers[order].T, strict=True))
    table = ColumnTable(path, (TIME, *numbers), {TIME: times_s[order], **numbers}, {}, note)
    mapping = replace(mapping, columns={TIME: ColumnSource(TIME), **mapping.columns}, missing="hold")
    return import_table(table, mapping=mapping, findings=rows.findings)


def _listed(topics: Sequence[Topic]) -> str:
    named = [f"{topic.name} ({topic.message_type}, {topic.n_messages})" for topic in topics[:MAX_LISTED_TOPICS]]
    if len(topics) > MAX_LISTED_TOPICS:
        named.append(f"{len(topics) - MAX_LISTED_TOPICS} more")
    return f"the topics {', '.join(named)}" if named else "no topics"


def _field_paths(bag: Bag, mapping: ColumnMapping) -> dict[str, FieldPath]:
    """The path of each column of the mapping. Raises DataError for a column without a topic."""
    gate = [mapping.throttle_gate] if mapping.throttle_gate else []
    columns = [source.name for source in mapping.columns.values()] + gate + list(mapping.references)
    return {column: _field_path(bag, column) for column in columns}


def _field_path(bag: Bag, column: str) -> FieldPath:
    """The path of a column: of the longest topic whose messages have its first field, or else of the longest one.

    Raises:
        DataError: the column is not a field of a topic with messages.
    """
    topics = sorted({topic.name for topic in bag.topics if topic.n_messages > 0}, key=len, reverse=True)
    paths = [path for topic in topics if (path := field_path(column, topic)) is not None]
    if len(paths) > 1:
        return next((path for path in paths if path.steps[0][0] in bag.fields(path.topic)), paths[0])
    if paths:
        return paths[0]
    if column.rstrip("/") in topics:
        fields = ", ".join(bag.fields(column.rstrip("/")))
        raise DataError(f"'{column}' is a topic of {bag.path.name}; add a field of its messages, which have {fields}.")
    has_topic = any(column.startswith(f"{topic.name}/") for topic in bag.topics)
    near = [] if has_topic else difflib.get_close_matches(column, topics, n=1, cutoff=0.3)
    hint = f" (is it '{near[0]}'?)" if near else ""
    raise DataError(
        f"'{column}' is not a field of a topic with messages in {bag.path.name}{hint}, which has "
        f"{_listed(bag.topics)}; write /topic/field/field."
    )


@dataclass(frozen=True, slots=True)
class _Rows:
    """A row for each message with a number in a column; the other cells are NaN.

    Attributes:
        columns: names of the columns.
        numbers: cells (N, number of columns).
        topics: topic of each message (N,).
        received_s: times of reception (N,) [s].
        stamps_s: stamps of the headers (N,) [s]; NaN for a message without a header.
        findings: messages that were left out.
    """

    columns: tuple[str, ...]
    numbers: FloatArray
    topics: np.ndarray
    received_s: FloatArray
    stamps_s: FloatArray
    findings: list[Finding]


def _rows_of(bag: Bag, paths: Mapping[str, FieldPath]) -> _Rows:
    """Read the messages of the paths. A message with a number that is not finite is left out.

    Raises:
        DataError: a message cannot be read, or a column has no number.
    """
    columns = tuple(paths)
    by_topic: dict[str, dict[int, FieldPath]] = {}
    for index, path in enumerate(paths.values()):
        by_topic.setdefault(path.topic, {})[index] = path
    counts: Counter[tuple[str, str]] = Counter()
    elements: dict[str, str] = {}
    rows, topics, received_s, stamps_s = [], [], [], []
    for message in bag.messages(by_topic):
        samples: dict[int, Sample] = {}
        for index, path in by_topic[message.topic].items():
            try:
                samples[index] = sample(message.content, path)
            except MissingElementError as error:
                elements[columns[index]] = str(error)
        is_finite = all(math.isfinite(one.value) for one in samples.values())
        use = (USED if is_finite else NOT_FINITE) if samples else NO_ELEMENT
        counts[message.topic, use] += 1
        if use != USED:
            continue
        row = np.full(len(columns), np.nan)
        row[list(samples)] = [one.value for one in samples.values()]
        rows.append(row)
        topics.append(message.topic)
        received_s.append(message.received_ns * 1e-9)
        stamps_s.append(next((one.stamp_ns * 1e-9 for one in samples.values() if one.stamp_ns is not None), np.nan))
    findings = [finding for topic in by_topic for finding in _left_out(bag, topic, counts)]
    numbers = np.array(rows).reshape(-1, len(columns))
    for column, is_empty in zip(columns, np.isnan(numbers).all(axis=0), strict=True):
        if is_empty:
            reasons = [finding.sentence for finding in findings if finding.channel == paths[column].topic]
            reasons += [f"The last message has {elements[column]}."] if column in elements else []
            raise DataError(f"{bag.path.name} has no number in '{column}': {' '.join(reasons)}")
    return _Rows(columns, numbers, np.array(topics), np.array(received_s), np.array(stamps_s), findings)


def _left_out(bag: Bag, topic: str, counts: Mapping[tuple[str, str], int]) -> list[Finding]:
    """Findings about the messages of a topic that have no row."""
    n_messages = sum(one.n_messages for one in bag.topics if one.name == topic)
    n_read = sum(counts[topic, use] for use in (USED, NO_ELEMENT, NOT_FINITE))
    findings = []
    if n_read < n_messages:
        sentence = (
            f"The index of {bag.path.name} counts {n_messages} messages of {topic}, of which {n_read} can be read; "
            "correct the index with 'ros2 bag reindex', or import a .db3 or .mcap file of the bag."
        )
        findings.append(Finding("unread_messages", topic, Severity.WARNING, sentence, n_messages - n_read))
    for use, severity in ((NO_ELEMENT, Severity.INFO), (NOT_FINITE, Severity.REPAIRED)):
        if n := counts[topic, use]:
            sentence = f"{n} of {n_read} messages of {topic} {use} and were left out."
            findings.append(Finding("left_out_messages", topic, severity, sentence, n))
    return findings


def _message_times(path: Path, rows: _Rows, mapping: ColumnMapping) -> tuple[FloatArray, str]:
    """Times of the messages (N,) [s], and a note about their source.

    Raises:
        DataError: headers are required but missing, or their clock has another rate than that of the recorder.
    """
    times_s, sources = rows.received_s.copy(), []
    for topic in dict.fromkeys(rows.topics):
        is_topic = rows.topics == topic
        received_s, stamps_s = rows.received_s[is_topic], rows.stamps_s[is_topic]
        has_header = not np.isnan(stamps_s).any()
        if mapping.message_times == "header" and not has_header:
            raise DataError(
                f"The messages of {topic} in {path.name} have no header with a stamp; remove message_times."
            )
        lead_s = float(np.median(stamps_s - received_s)) if has_header else np.nan
        is_near = abs(lead_s) <= MAX_CLOCK_DIFFERENCE_S
        if mapping.message_times == "auto" and has_header and not is_near:
            _check_clock_rate(topic, np.ptp(stamps_s), np.ptp(received_s))
        if mapping.message_times == "header" or (mapping.message_times == "auto" and is_near):
            times_s[is_topic] = stamps_s
            side = "after" if lead_s > 0.0 else "before"
            sources.append(f"{topic} by its header ({abs(lead_s):.3g} s {side} reception)")
        else:
            sources.append(f"{topic} by the time of reception")
    return times_s, f"times of {', '.join(sources)}"


def _check_clock_rate(topic: str, header_s: float, received_s: float) -> None:
    """Raise DataError if the messages cover different times by their headers and by their reception [s]."""
    if abs(header_s - received_s) > MAX_CLOCK_DIFFERENCE_S:
        raise DataError(
            f"The messages of {topic} cover {header_s:.4g} s by their headers and {received_s:.4g} s by the clock of "
            "the recorder, as in a simulation that does not run in real time; record with --use-sim-time, or choose "
            "the clock with --message-times."
        )
