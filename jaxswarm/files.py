"""Files that are written completely or not at all, and the rows of `metrics.csv`."""

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RETURN = "eval/return"
Row = dict[str, Any]  # a line of metrics.csv; empty cells are NaN

INTEGERS = ("update", "agent_steps", "seed")
LEADING = ("update", "agent_steps", "wall_seconds", "seed", "eval/return", "eval/return_std")


def replace_text(path: Path, text: str) -> None:
    """Writes a file as a whole: after a crash it has its old content or the new."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """`replace_text` for what is no text."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def append_row(path: Path, row: Row) -> None:
    """Appends a line that is on disk when this returns; the first row of a file fixes its columns."""
    is_new = not path.exists() or path.stat().st_size == 0
    columns = _columns(row) if is_new else _header(path)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    if is_new:
        writer.writerow(columns)
    writer.writerow([_cell(row.get(name, math.nan)) for name in columns])
    with open(path, "a", encoding="utf-8", newline="") as file:
        file.write(buffer.getvalue())
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[Row]:
    """All complete rows; a last line that was cut off is left out."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    if not lines:
        return []
    complete = [line for line in lines[1:] if len(line) == len(lines[0])]
    return [{name: _number(name, cell) for name, cell in zip(lines[0], line, strict=True)} for line in complete]


def keep_rows_before(path: Path, update: int) -> list[Row]:
    """Removes rows from `update` on, and any torn line; what remains is returned."""
    rows = [row for row in read_rows(path) if row["update"] < update]
    if path.exists():
        write_rows(path, rows)
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replaces the file; all rows have the same columns, and without any the file is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerows([list(rows[0]), *([_cell(x) for x in row.values()] for row in rows)] if rows else [])
    replace_text(path, buffer.getvalue())


def _columns(row: Mapping[str, Any]) -> list[str]:
    return [name for name in LEADING if name in row] + sorted(set(row) - set(LEADING))


def _header(path: Path) -> list[str]:
    with open(path, encoding="utf-8", newline="") as file:
        return next(csv.reader(file))


def _cell(value: Any) -> str:
    """Shortest text that reads back to the same number; metrics are single precision."""
    if isinstance(value, int):
        return str(value)
    return "" if math.isnan(value) else str(np.float32(value))


def _number(name: str, cell: str) -> float | int:
    if name in INTEGERS:
        return int(cell)
    return float(cell) if cell else math.nan
