"""A user's own files and modules, which register tasks, aggregators and learners."""

import importlib.util
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm.config.schema import ConfigError

have_run: set[str] = set()  # once in a process


def run(places: Any) -> Any:
    """Runs files and modules; returns files as full paths. What is no list of texts is returned as it is."""
    places = [places] if isinstance(places, str) else places
    if not isinstance(places, list) or not all(isinstance(place, str) for place in places):
        return places  # which `config.validate` says
    full = [str(Path(place).resolve()) if place.endswith(".py") else place for place in places]
    for place in full:
        if place not in have_run:
            try:
                _run(place)
            except Exception as error:  # whatever a user's file leads to
                raise ConfigError(f"cannot import {place}: {type(error).__name__}: {error}") from error
            have_run.add(place)
    return full


def place(cls: type) -> str | None:
    """What to run where a class is needed again; `None` for those of this package.

    A `ConfigError` for a class of a notebook or a script, which would do all that they do once more.
    """
    module = cls.__module__
    if module.partition(".")[0] == "jaxswarm":
        return None
    file = getattr(sys.modules.get(module), "__file__", None)
    if module == "__main__" or file is None:
        raise ConfigError(f"{cls.__name__} is in no file that can be imported")
    return module if "." in module else str(Path(file).resolve())


def keep(places: Sequence[str], run_dir: Path) -> None:
    """Copies files into the run folder, for where the folder is taken without them."""
    for place, copy in zip(places, _copies(places, run_dir), strict=True):
        if place.endswith(".py") and Path(place).exists():
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(place, copy)


def found(places: Sequence[str], run_dir: Path) -> list[str]:
    """The places, with what the run folder has kept of files that are no longer there."""
    return [
        str(copy) if place.endswith(".py") and not Path(place).exists() and copy.exists() else place
        for place, copy in zip(places, _copies(places, run_dir), strict=True)
    ]


def _copies(places: Sequence[str], run_dir: Path) -> list[Path]:
    """Where copies are; files may have the same name."""
    return [run_dir / "imports" / f"{number}-{Path(place).name}" for number, place in enumerate(places)]


def _run(place: str) -> None:
    """Runs a file or a module, which may import what is beside it; a module is also looked for where the user is."""
    is_file = place.endswith(".py")
    folder = str(Path(place).parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    _run_file(place) if is_file else importlib.import_module(place)


def _run_file(path: str) -> None:
    name = f"imported_{len(have_run)}_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)  # where annotations are looked up
    spec.loader.exec_module(sys.modules[name])
