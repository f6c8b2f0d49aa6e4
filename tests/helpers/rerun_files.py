"""Contents of .rrd files, read with the reader of rerun."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


def entities(path: Path) -> set[str]:
    """Paths of all entities of the recording."""
    columns = RrdReader(str(path)).store().schema().component_columns()
    return {column.entity_path.strip("/") for column in columns}


def cells(path: Path, component: str, timeline: str | None) -> dict[str, list[tuple[int, list[Any]]]]:
    """Values of a component (``Scalars:scalars``) by entity, each with its time on a timeline [ns or number].

    ``timeline=None`` gives the static values, with time 0.
    """
    values: dict[str, list[tuple[int, list[Any]]]] = {}
    for entity, batch in _batches(RrdReader(str(path)).stream()):
        static = not any((f.metadata or {}).get(b"rerun:kind") == b"index" for f in batch.schema)
        if static != (timeline is None) or (timeline is not None and timeline not in batch.schema.names):
            continue
        times = [0] * batch.num_rows if timeline is None else batch.column(timeline).cast("int64").to_pylist()
        for name in batch.schema.names:
            if (batch.schema.field(name).metadata or {}).get(b"rerun:component", b"").decode() == component:
                rows = zip(times, batch.column(name).to_pylist(), strict=True)
                values.setdefault(entity, []).extend((t, cell) for t, cell in rows if cell)
    return {entity: sorted(rows, key=lambda row: row[0]) for entity, rows in values.items()}


@dataclass(frozen=True)
class BlueprintView:
    """A view of a blueprint: its kind, name and the entities that it queries."""

    kind: str
    name: str
    origin: str
    query: tuple[str, ...]


def views(path: Path) -> list[BlueprintView]:
    """Views of the blueprint that a viewer shows: the last one of the file."""
    found: dict[str, dict[str, list[Any]]] = {}
    for entity, batch in _newest_blueprint(path):
        for field in batch.schema:
            component = (field.metadata or {}).get(b"rerun:component", b"").decode()
            if entity.startswith("view/") and component:
                found.setdefault(entity, {})[component] = batch.column(field.name).to_pylist()[-1]
    kinds = {e: c for e, c in found.items() if "ViewBlueprint:class_identifier" in c}
    return [
        BlueprintView(
            c["ViewBlueprint:class_identifier"][0],
            c["ViewBlueprint:display_name"][0],
            c["ViewBlueprint:space_origin"][0],
            tuple(found.get(f"{entity}/ViewContents", {}).get("ViewContents:query", [])),
        )
        for entity, c in kinds.items()
    ]


def tabs(path: Path) -> list[str]:
    """Names of the named containers of the blueprint that a viewer shows."""
    names = []
    for entity, batch in _newest_blueprint(path):
        for field in batch.schema:
            if (field.metadata or {}).get(b"rerun:component") == b"ContainerBlueprint:display_name":
                names.extend(name for cell in batch.column(field.name).to_pylist() for name in cell or [])
                assert entity.startswith("container/")
    return names


def _newest_blueprint(path: Path) -> list[tuple[str, Any]]:
    reader = RrdReader(str(path))
    stores = [list(_batches(reader.stream(store=store))) for store in reader.blueprints()]
    return max(stores, key=lambda store: max(batch.column(0).to_pylist()[-1] for _, batch in store))


def _batches(stream: Any) -> Iterator[tuple[str, Any]]:
    for chunk in stream.to_chunks():
        yield chunk.entity_path.strip("/"), chunk.to_record_batch()
