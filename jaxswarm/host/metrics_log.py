"""`metrics.csv` of a run and its copy, which restores it: both are only appended to, and checkpoints store a digest.

The copy is `checkpoints/metrics.csv`, so that a deleted or damaged `metrics.csv` loses no evaluation.
"""

import csv
import hashlib
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypedDict

from jaxswarm import files
from jaxswarm.files import Row

_NAME = "metrics.csv"


class RowsDigest(TypedDict):
    """Number of rows and SHA-256 of their lines, including the header."""

    count: int
    sha256: str


class MetricsLog:
    """Append rows to `metrics.csv` and to its copy. `lines` are the header and the rows to begin with."""

    def __init__(self, run_dir: Path, lines: Sequence[str]):
        self._run_dir = run_dir
        self._columns = next(csv.reader(lines[:1]), [])
        self._count = max(len(lines) - 1, 0)
        self._hash = _hash(lines)
        for path in _paths(run_dir):
            if lines or path.exists():
                files.replace_text(path, _text(lines))

    @property
    def digest(self) -> RowsDigest:
        """Digest of all rows that have been appended."""
        return RowsDigest(count=self._count, sha256=self._hash.hexdigest())

    def append(self, rows: Sequence[Row]) -> None:
        """Append rows to both files and flush them to disk. The first row determines the columns.

        A file that somebody has deleted is restored from the other one. Raises an `OSError` if that is not possible.
        """
        if not rows:
            return
        header = [] if self._columns else [files.columns(rows[0])]
        self._columns = self._columns or header[0]
        lines = files.format_lines([*header, *(files.cells(row, self._columns) for row in rows)])
        self._restore_deleted()
        for path in _paths(self._run_dir):
            files.wait_for_space(lambda path=path: files.append_text(path, _text(lines)), self._run_dir)
        self._count += len(rows)
        self._hash.update(_text(lines).encode())

    def _restore_deleted(self) -> None:
        paths = _paths(self._run_dir)
        missing = [path for path in paths if self._count and not path.exists()]
        for path in missing:
            path.parent.mkdir(exist_ok=True)
            lines = verified_lines(self._run_dir, self.digest)
            if lines is None:
                raise FileNotFoundError(2, "the file was deleted or changed during training", str(path))
            files.replace_text(path, _text(lines))
            print(f"warning: {path} was deleted during training; it is restored", file=sys.stderr)


def verified_lines(run_dir: Path, digest: RowsDigest, warn: Callable[[str], None] = lambda _: None) -> list[str] | None:
    """Return the header and the rows with this digest, of `metrics.csv` or else of its copy, without later rows.

    Returns `None` if neither has these rows. `warn` gets one line if the copy was needed.
    """
    original, copy = _paths(run_dir)
    size = digest["count"] + bool(digest["count"])
    for path in (original, copy):
        lines = _lines(path)
        if len(lines) >= size and _hash(lines[:size]).hexdigest() == digest["sha256"]:
            if path == copy:
                warn(f"{original} has been changed or damaged; its {digest['count']} rows are restored from {copy}")
            return lines[:size]
    return None


def _paths(run_dir: Path) -> tuple[Path, Path]:
    return run_dir / _NAME, run_dir / "checkpoints" / _NAME


def _lines(path: Path) -> list[str]:
    """Return the complete lines of a file; a file that cannot be read has none."""
    try:
        return files.read_lines(path)
    except (OSError, ValueError):
        return []


def _text(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _hash(lines: Iterable[str]) -> "hashlib._Hash":
    return hashlib.sha256(_text(lines).encode())
