"""Atomic writing of files, and reading and writing of `metrics.csv`."""

import contextlib
import csv
import io
import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RETURN = "eval/return"
Row = dict[str, Any]  # row of metrics.csv by column; empty cells are NaN

MAX_CELL = 2**53  # magnitude of integers, which floats represent exactly
INTEGERS = ("update", "agent_steps", "seed")
LEADING = ("update", "agent_steps", "wall_seconds", "seed", "eval/return", "eval/return_std")


def replace_text(path: Path, text: str) -> None:
    """Write a text file atomically: after a crash it has either its old content or the new one."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """Write a binary file atomically, as `replace_text` does."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def read_text(path: Path) -> str:
    """Return the content of a text file, with or without a byte order mark; a missing file is empty."""
    return path.read_text(encoding="utf-8-sig") if path.exists() else ""


def is_vacant(folder: Path) -> bool:
    """Return whether a folder does not exist, is empty, or holds only temporary files of an interrupted write."""
    return not folder.exists() or (folder.is_dir() and all(map(_is_temporary, folder.iterdir())))


def remove_temporary_files(folder: Path) -> None:
    """Remove temporary files that an interrupted write has left in a folder; no other process may write there."""
    for path in filter(_is_temporary, folder.iterdir()):
        path.unlink(missing_ok=True)


def claim_folder(path: Path) -> Path:
    """Create an empty folder of this name, with a number appended if the name is taken, and return its path.

    Processes that claim the same name at the same time get different folders.
    """
    for number in itertools.count(1):
        claimed = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            claimed.mkdir(parents=True)
        except FileExistsError:
            continue
        return claimed
    raise AssertionError


@contextlib.contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """Remove the folder at the end if nothing was written into it."""
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # it holds files, or does not exist
            folder.rmdir()


def _is_temporary(path: Path) -> bool:
    return path.is_file() and path.name.startswith(".") and path.suffix == ".tmp"


def append_row(path: Path, row: Row) -> None:
    """Append a row to a CSV file and flush it to disk.

    The first row of a file determines its columns. Missing values are NaN, which is an empty cell.
    """
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
    """Read all complete rows. A truncated last line is skipped; a missing file has no rows."""
    text = read_text(path)
    lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    if not lines:
        return []
    complete = [line for line in lines[1:] if len(line) == len(lines[0])]
    return [{name: _number(name, cell) for name, cell in zip(lines[0], line, strict=True)} for line in complete]


def keep_rows_before(path: Path, update: int) -> list[Row]:
    """Remove the rows from `update` on and truncated lines; return the remaining rows."""
    rows = [row for row in read_rows(path) if row["update"] < update]
    if path.exists():
        write_rows(path, rows)
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replace the file by these rows, which must have the same columns. Without rows the file is empty."""
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
    """Return the shortest text that gives the same number in single precision, the precision of metrics."""
    if isinstance(value, int):
        return str(value)
    return "" if math.isnan(value) else str(np.float32(value))


def _number(name: str, cell: str) -> float | int:
    if name in INTEGERS:
        number = int(cell)
        if abs(number) > MAX_CELL:
            raise ValueError(f"{name}: must be an integer of at most {MAX_CELL} in magnitude")
        return number
    return float(cell) if cell else math.nan
