"""Tables of records, checked while they are made."""

from __future__ import annotations

from logs.recording.export import Cell, Tables
from uavctl.records import Record


def tabulate(records: list[tuple[str, int, Record]]) -> dict[str, list[dict[str, Cell]]]:
    """Rows of each table, by the names of their columns."""
    tables = Tables()
    for topic, _, record in records:
        tables.learn(topic, record)
    columns = tables.columns()
    rows: dict[str, list[dict[str, Cell]]] = {name: [] for name in columns}
    for topic, at_ns, record in records:
        for name, cells in tables.rows(topic, at_ns, record):
            names = [column.name for column in columns[name]]
            assert len(set(names)) == len(names)
            for column, cell in zip(columns[name], cells, strict=True):
                assert cell is None or type(cell) is column.kind, column
            rows[name].append(dict(zip(names, cells, strict=True)))
    return rows
