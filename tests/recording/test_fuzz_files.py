"""Damaged and hostile files: the readers raise only errors of carlab, each in one sentence with the name of the file.

Cases are drawn with a fixed seed; the file name in a message contains the number of the case.
"""

import gzip
import json

import foreign_drive as foreign
import numpy as np
import pytest
import ros_bags
from mcap.writer import Writer

from carlab.core.errors import CarlabError
from carlab.recording.column_mapping import load_mapping
from carlab.recording.csv.foreign import import_csv
from carlab.recording.mcap import schemas as schemas
from carlab.recording.mcap.messages import ended_to_metadata, started_to_metadata
from carlab.recording.mcap.sink import McapSink
from carlab.recording.mcap.source import read_episode
from carlab.recording.recorder import Recorder
from carlab.recording.ros.bag_import import import_bag
from tests.helpers.episode_documents import make_documents

CELLS = ["", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "true", "x", '"', "9" * 400, "\x00", "1,2", "0x1f"]
JSON_TEXTS = ["", "null", "3", "[]", "[1]", "{}", '"a"', "[[1]]", "[[1, 2, 3]]", "[null, 1, 2]", "[" * 100_000, "nan"]
JSON_TEXTS += ["1e999", "-1", "9" * 5000, '{"a": "b"}', '{"a": null}', "[{}, {}, {}]", '[["a", "b"]]']


def damaged(rng, content):
    """Content with random truncations, overwritten, inserted or removed bytes."""
    content = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        position = int(rng.integers(len(content)))
        match int(rng.integers(4)):
            case 0:
                content = content[: max(position, 1)]
            case 1:
                content[position] = int(rng.integers(256))
            case 2:
                content[position:position] = rng.bytes(int(rng.integers(1, 9)))
            case _:
                del content[position : position + int(rng.integers(1, 40))]
        if not content:
            return b"\x00"
    return bytes(content)


def refusal(read, path):
    """Message of the CarlabError that ``read`` raises; None if the file can be read. Other errors are not caught."""
    try:
        read(path)
    except CarlabError as error:
        return str(error)
    return None


@pytest.fixture(scope="module")
def rows():
    columns = foreign.drive(np.arange(60) / 30.0)
    return [list(columns), *np.column_stack(list(columns.values())).astype(str).tolist()]


@pytest.mark.filterwarnings("error")
class TestCsv:
    def test_damaged_csv_is_read_or_refused(self, rows, tmp_path):
        rng = np.random.default_rng(1)
        plain = "\n".join(",".join(row) for row in rows).encode()
        refused = 0
        for case in range(60):
            path = tmp_path / f"{case}.csv"
            path.write_bytes(gzip.compress(damaged(rng, plain)) if case % 5 == 0 else damaged(rng, plain))
            refused += refusal(import_csv, path) is not None
        assert refused > 20

    def test_damaged_gzip_is_read_or_refused(self, rows, tmp_path):
        rng = np.random.default_rng(2)
        packed = gzip.compress("\n".join(",".join(row) for row in rows).encode())
        for case in range(50):
            path = tmp_path / f"{case}.csv.gz"
            path.write_bytes(damaged(rng, packed))
            refusal(import_csv, path)

    def test_cells_of_another_type_are_read_or_refused(self, rows, tmp_path):
        rng = np.random.default_rng(3)
        for case in range(80):
            changed = [list(row) for row in rows]
            column = int(rng.integers(len(rows[0])))
            is_whole_column = rng.random() < 0.3
            cell = str(rng.choice(CELLS))
            for row in range(1, len(rows)) if is_whole_column else rng.integers(0, len(rows), 4).tolist():
                changed[row][column] = cell
            path = tmp_path / f"{case}.csv"
            path.write_text("\n".join(",".join(row) for row in changed), encoding="utf-8")
            refusal(import_csv, path)


def recording_with(path, documents, monkeypatch, key, text):
    """Write a recording whose end record has ``text`` under ``key``."""
    with monkeypatch.context() as patch:
        record = {**ended_to_metadata(documents[-1]), key: text}
        patch.setattr("carlab.recording.mcap.sink.ended_to_metadata", lambda _: record)
        with Recorder([McapSink(path)]) as recorder:
            for document in documents:
                recorder.emit(document)
    return path


def metadata_file(path, record, config=b""):
    """Write a complete MCAP file with one episode record and no message."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="carlab 1")
        writer.add_attachment(0, 0, schemas.CONFIG_ATTACHMENT, "text/plain", config)
        writer.add_metadata(schemas.EPISODE_RECORD, record)
        writer.finish()
    return path


class TestMcap:
    def test_damaged_mcap_is_read_or_refused(self, tmp_path):
        rng = np.random.default_rng(4)
        complete = tmp_path / "complete.mcap"
        with Recorder([McapSink(complete)]) as recorder:
            for document in make_documents(20):
                recorder.emit(document)
        content = complete.read_bytes()
        for case in range(100):
            path = tmp_path / f"{case}.mcap"
            path.write_bytes(damaged(rng, content))
            refusal(read_episode, path)

    def test_metadata_of_another_type_is_refused_with_the_name_of_the_file(self, tmp_path):
        documents = make_documents(3)
        record = {**started_to_metadata(documents[0]), **ended_to_metadata(documents[-1])}
        for key in ("episode", "start_t_s", "reality", "goal", "arena_m", "end_reason", "statistics"):
            for case, text in enumerate(JSON_TEXTS):
                path = metadata_file(tmp_path / f"{case}.mcap", {**record, key: text})
                message = refusal(read_episode, path)
                assert message is not None  # the file has no tick
                assert str(path) in message, (key, text[:20])
                assert len(message) < 600, (key, text[:20])

    def test_configuration_that_is_not_text_is_refused(self, tmp_path):
        path = metadata_file(tmp_path / "c.mcap", started_to_metadata(make_documents(3)[0]), b"\xff\xfe")
        assert str(path) in refusal(read_episode, path)

    def test_goal_with_too_few_numbers_is_refused(self, tmp_path):
        record = started_to_metadata(make_documents(3)[0]) | {"goal": json.dumps([1.0])}
        message = refusal(read_episode, metadata_file(tmp_path / "goal.mcap", record))
        assert schemas.EPISODE_RECORD in message

    @pytest.mark.parametrize("text", ["[1]", "3", "null", '{"a": "b"}', '{"a": null}', '{"a": [1]}'])
    def test_statistics_that_are_not_numbers_are_refused(self, tmp_path, monkeypatch, text):
        path = recording_with(tmp_path / "end.mcap", make_documents(3), monkeypatch, "statistics", text)
        message = refusal(read_episode, path)
        assert message is not None
        assert "statistics are not a mapping" in message
        assert str(path) in message


class TestRosBag:
    @pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "drive_mcap", "drive_sqlite3"])
    def test_damaged_bag_is_read_or_refused(self, name, tmp_path):
        rng = np.random.default_rng(4)
        whole = ros_bags.write_bag(tmp_path / name, foreign.drive(np.arange(60) / 30.0))
        (tmp_path / "columns.toml").write_text(ros_bags.MAPPING)
        mapping = load_mapping(tmp_path / "columns.toml")
        files = sorted(whole.iterdir()) if whole.is_dir() else [whole]
        contents = [file.read_bytes() for file in files]
        refused = 0
        for case in range(40):
            chosen = case % len(files)
            files[chosen].write_bytes(damaged(rng, contents[chosen]))
            message = refusal(lambda path: import_bag(path, mapping=mapping), whole)
            files[chosen].write_bytes(contents[chosen])
            refused += message is not None
            assert message is None or (whole.name in message and "\n" not in message), (case, message)
        assert refused > 10
