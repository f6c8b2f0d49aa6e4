"""Import of a ROS bag: its messages become a table with one row for each message, and values are held between them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.recording.column_mapping import ColumnMapping, ColumnSource
from carlab.recording.csv.foreign import ImportedRecording, import_table
from carlab.recording.csv.table import ColumnTable
from carlab.recording.ros.bag import Bag, Topic, opened_bag
from carlab.recording.ros.fields import FieldPath, field_path, sample

TIME = "t"
"""Column with the times of the messages [s since 1970]."""
MAX_CLOCK_DIFFERENCE_S = 0.5
"""[s] Headers whose stamps differ more from the times of reception have another clock, such as simulated time."""
MAX_LISTED_TOPICS = 30


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
        paths = _field_paths(bag, mapping)
        table = _message_table(bag, paths, mapping)
    columns = {TIME: ColumnSource(TIME), **mapping.columns}
    return import_table(table, mapping=replace(mapping, columns=columns, missing="hold"))


def _listed(topics: Sequence[Topic]) -> str:
    named = [f"{topic.name} ({topic.message_type}, {topic.n_messages})" for topic in topics[:MAX_LISTED_TOPICS]]
    if len(topics) > MAX_LISTED_TOPICS:
        named.append(f"{len(topics) - MAX_LISTED_TOPICS} more")
    return f"the topics {', '.join(named)}" if named else "no topics"


def _field_paths(bag: Bag, mapping: ColumnMapping) -> dict[str, FieldPath]:
    """The path of each column of the mapping. Raises DataError for a column without a topic."""
    gate = [mapping.throttle_gate] if mapping.throttle_gate else []
    topics = [topic.name for topic in bag.topics if topic.n_messages > 0]
    paths = {}
    for column in [source.name for source in mapping.columns.values()] + gate + list(mapping.references):
        path = field_path(column, topics)
        if path is None:
            near = difflib.get_close_matches(column, topics, n=1, cutoff=0.3)
            hint = f" (is it '{near[0]}'?)" if near else ""
            raise DataError(
                f"'{column}' is not a field of a topic with messages in {bag.path.name}{hint}, which has "
                f"{_listed(bag.topics)}; write /topic/field/field."
            )
        paths[column] = path
    return paths


def _message_table(bag: Bag, paths: Mapping[str, FieldPath], mapping: ColumnMapping) -> ColumnTable:
    """A row for each message with a number in a column, ordered by time; the other cells of the row are NaN."""
    columns = list(paths)
    by_topic: dict[str, list[int]] = {}
    for index, column in enumerate(columns):
        by_topic.setdefault(paths[column].topic, []).append(index)
    topics, received, stamps, rows = [], [], [], []
    for message in bag.messages(by_topic):
        samples = {index: sample(message.content, paths[columns[index]]) for index in by_topic[message.topic]}
        found = {index: one for index, one in samples.items() if one is not None}
        if not found:
            continue
        row = np.full(len(columns), np.nan)
        row[list(found)] = [one.value for one in found.values()]
        stamp_ns = next((one.stamp_ns for one in found.values() if one.stamp_ns is not None), None)
        topics.append(message.topic)
        received.append(message.received_ns)
        stamps.append(np.nan if stamp_ns is None else (stamp_ns - message.received_ns) * 1e-9)
        rows.append(row)
    if not rows:
        raise DataError(f"{bag.path.name} has no message with a number of the mapping; check the columns.")
    received_s, lead_s = np.array(received) * 1e-9, np.array(stamps)
    times_s, note = _message_times(bag.path, np.array(topics), received_s, lead_s, mapping)
    order = np.argsort(times_s, kind="stable")
    table = np.array(rows)[order]
    numbers = {name: table[:, index] for index, name in enumerate(columns)}
    return ColumnTable(bag.path, (TIME, *columns), {TIME: times_s[order], **numbers}, {}, note)


def _message_times(
    path: Path, topics: np.ndarray, received_s: FloatArray, lead_s: FloatArray, mapping: ColumnMapping
) -> tuple[FloatArray, str]:
    """Times of the messages (N,) [s], and a note about their source. ``lead_s`` is header minus reception, or NaN."""
    times_s, sources = received_s.copy(), []
    for topic in dict.fromkeys(topics):
        rows = topics == topic
        has_header = not np.isnan(lead_s[rows]).any()
        if mapping.message_times == "header" and not has_header:
            raise DataError(
                f"The messages of {topic} in {path.name} have no header with a stamp; remove message_times."
            )
        is_near = has_header and abs(np.median(lead_s[rows])) <= MAX_CLOCK_DIFFERENCE_S
        use_header = mapping.message_times == "header" or (mapping.message_times == "auto" and is_near)
        if use_header:
            times_s[rows] += lead_s[rows]
        sources.append(f"{topic} by {'its header' if use_header else 'the time of reception'}")
    return times_s, f"times of {', '.join(sources)}"
