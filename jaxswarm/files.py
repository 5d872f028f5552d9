"""Atomic writing of files, and reading and writing of `metrics.csv`."""

import contextlib
import csv
import errno
import io
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RETURN = "eval/return"
SECONDS_FOR_SPACE = 60.0  # how long training waits for space on a full disk
Row = dict[str, Any]  # row of metrics.csv by column; empty cells are NaN

MAX_CELL = 2**53  # magnitude of integers, which floats represent exactly
INTEGERS = ("update", "agent_steps", "env_steps", "seed")
LEADING = ("update", "agent_steps", "env_steps", "wall_seconds", "seed", "eval/return", "eval/return_std")


def replace_text(path: Path, text: str) -> None:
    """Write a text file atomically: after a crash it has either its old content or the new one."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """Write a binary file atomically, as `replace_text` does."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def append_text(path: Path, text: str) -> None:
    """Append to a text file and flush it to disk; if that fails, the file keeps its old content."""
    with open(path, "ab", buffering=0) as file:
        size = file.tell()
        try:
            if file.write(text.encode()) < len(text.encode()):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise


def wait_for_space(write: Callable[[], None], folder: Path) -> None:
    """Call `write`, and call it again for up to `SECONDS_FOR_SPACE` while the disk of `folder` is full."""
    deadline = time.monotonic() + SECONDS_FOR_SPACE
    is_reported = False
    while True:
        try:
            return write()
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT) or time.monotonic() >= deadline:
                raise
        if not is_reported:
            print(f"warning: {folder}: no space left on device; waiting for space", file=sys.stderr, flush=True)
            is_reported = True
        time.sleep(0.5)


def read_text(path: Path) -> str:
    """Return the content of a text file, with or without a byte order mark; a missing file is empty."""
    return path.read_text(encoding="utf-8-sig") if path.exists() else ""


def size_text(path: Path) -> str:
    """Return the size of a file with its unit, such as "12 kB" or "3.4 MB"."""
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 999_500 else f"{size / 1e3:.0f} kB" if size >= 999.5 else f"{size} bytes"


def is_vacant(folder: Path) -> bool:
    """Return whether a folder does not exist, is empty, or holds only what a killed run wrote before its config."""
    return not folder.exists() or (
        folder.is_dir() and all(_is_temporary(path) or path.name == "imports" for path in folder.iterdir())
    )


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


def read_rows(path: Path) -> list[Row]:
    """Read all complete rows. A truncated last line is skipped; a missing file has no rows.

    Raises a `ValueError` for a file that is damaged in another way.
    """
    return parse_rows(read_lines(path))


def read_lines(path: Path) -> list[str]:
    """Return the complete lines of a text file, without a truncated last line; a missing file has none."""
    text = read_text(path)
    return text[: text.rfind("\n") + 1].splitlines()


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replace the file by these rows, which must have the same columns. Without rows the file is empty."""
    replace_text(path, "".join(f"{line}\n" for line in format_rows(rows)))


def format_rows(rows: Sequence[Row]) -> list[str]:
    """Return the lines of a CSV file with these rows, which must have the same columns, below a header."""
    return format_lines([list(rows[0]), *(cells(row, list(rows[0])) for row in rows)]) if rows else []


def parse_rows(lines: Sequence[str]) -> list[Row]:
    """Return the rows of the lines of a CSV file with a header. Lines of another length are skipped."""
    header, *others = csv.reader(lines) if lines else [[]]
    complete = [line for line in others if len(line) == len(header)]
    return [{name: _number(name, cell) for name, cell in zip(header, line, strict=True)} for line in complete]


def columns(row: Mapping[str, Any]) -> list[str]:
    """Return the order of the columns of a file that begins with this row."""
    return [name for name in LEADING if name in row] + sorted(set(row) - set(LEADING))


def cells(row: Row, names: Sequence[str]) -> list[str]:
    """Return the cells of a row in these columns. Missing values are NaN, which is an empty cell."""
    return [_cell(row.get(name, math.nan)) for name in names]


def format_lines(table: Sequence[Sequence[str]]) -> list[str]:
    """Return each line of a table as a line of a CSV file."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    return buffer.getvalue().splitlines()


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
