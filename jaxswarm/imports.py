"""A user's own files and modules, which register tasks, aggregators and learners."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

from jaxswarm.schema import ConfigError

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
                _run_file(place) if place.endswith(".py") else importlib.import_module(place)
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


def _run_file(path: str) -> None:
    name = f"imported_{len(have_run)}_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)  # where annotations are looked up
    spec.loader.exec_module(sys.modules[name])
