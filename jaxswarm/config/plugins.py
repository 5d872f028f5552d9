"""Imports of user files and modules, which register tasks, aggregators and learners."""

import importlib.util
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm.config.schema import ConfigError

have_run: set[str] = set()  # each import runs once in a process


def run(imports: Any) -> Any:
    """Run user files (paths that end with .py) and modules, and return them with absolute paths.

    A single text stands for a list of one import. Other values are returned unchanged, for `validate` to reject.
    Raises a `ConfigError` if an import fails.
    """
    imports = [imports] if isinstance(imports, str) else imports
    if not isinstance(imports, list) or not all(isinstance(one, str) for one in imports):
        return imports
    absolute = [str(Path(one).resolve()) if one.endswith(".py") else one for one in imports]
    for one in absolute:
        if one not in have_run:
            try:
                _run(one)
            except Exception as error:  # a user's file can raise anything
                raise ConfigError(f"cannot import {one}: {type(error).__name__}: {error}") from error
            have_run.add(one)
    return absolute


def import_of(cls: type) -> str | None:
    """Return the file or module that defines a class, as `run` takes it; `None` for classes of this package.

    Raises a `ConfigError` for a class of a notebook or of the main script, because these cannot be imported.
    """
    module = cls.__module__
    if module.partition(".")[0] == "jaxswarm":
        return None
    file = getattr(sys.modules.get(module), "__file__", None)
    if module == "__main__" or file is None:
        raise ConfigError(f"{cls.__name__}: must be defined in a file that can be imported, got module {module}")
    return module if "." in module else str(Path(file).resolve())


def keep(imports: Sequence[str], run_dir: Path) -> None:
    """Copy user files into the run folder, so that the folder can be moved without them."""
    for one, copy in zip(imports, _copies(imports, run_dir), strict=True):
        if one.endswith(".py") and Path(one).exists():
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(one, copy)


def locate(imports: Sequence[str], run_dir: Path) -> list[str]:
    """Return the imports, with the copies in the run folder for files that no longer exist."""
    return [
        str(copy) if one.endswith(".py") and not Path(one).exists() and copy.exists() else one
        for one, copy in zip(imports, _copies(imports, run_dir), strict=True)
    ]


def _copies(imports: Sequence[str], run_dir: Path) -> list[Path]:
    """Return the paths of the copies, numbered because several files may have the same name."""
    return [run_dir / "imports" / f"{number}-{Path(one).name}" for number, one in enumerate(imports)]


def _run(one: str) -> None:
    """Run a file or a module. Files in its folder, or in the working directory of a module, can be imported by it."""
    is_file = one.endswith(".py")
    folder = str(Path(one).parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    _run_file(one) if is_file else importlib.import_module(one)


def _run_file(path: str) -> None:
    name = f"imported_{len(have_run)}_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)  # annotations of classes are resolved there
    spec.loader.exec_module(sys.modules[name])
