"""Imports of user files and modules, which register tasks, aggregators and learners.

A run folder keeps copies of its imports, so that it can be moved. A copy is executed only if this user has trained with
the same code on this machine, which a list of digests in the user's state directory records, or inside of `trusting`.
"""

import contextlib
import hashlib
import importlib.util
import os
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm.config.schema import ConfigError

have_run: set[str] = set()  # digests of files and names of modules; each runs once in a process
_is_trusting = False  # copies are executed without a look at the list
_is_substituted = False  # stored imports are not executed, because the user has given others


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
        folder = str(Path(one).parent if one.endswith(".py") else Path.cwd())
        if folder not in sys.path:  # its other files can be imported, too
            sys.path.append(folder)
        _run(one)
    return absolute


def substitute(imports: Any) -> None:
    """Run these imports in place of those that run folders store, until the end of the context of `trusting`."""
    global _is_substituted  # noqa: PLW0603
    run(imports)
    _is_substituted = True


def run_stored(imports: Sequence[str], run_dir: Path) -> None:
    """Run the imports of a stored config, from their copies in the run folder.

    Files outside of the folder and modules of the working directory are never executed. Raises a `ConfigError` for
    these, and for code that this user has neither trained with nor allowed.
    """
    if _is_substituted:
        return
    found = [copy if copy.exists() else Path(one) for one, copy in zip(imports, _copies(imports, run_dir), strict=True)]
    for one, path in zip(imports, found, strict=True):
        if one.endswith(".py") and path == Path(one):
            raise ConfigError(f"imports: {run_dir} has no copy of {one}; give your own file with imports=PATH")
    require_trust([str(path) for path in found], run_dir)
    for path in found:
        with _without_working_directory():
            _run(str(path))


def require_trust(imports: Sequence[str], folder: Path) -> None:
    """Raise a `ConfigError` that lists the imports which this user has neither trained with nor allowed."""
    known = have_run if _is_trusting else have_run | _trusted()
    unknown = {one: key for one in imports if (key := _key(one)) not in known}
    if unknown and not _is_trusting:
        names = ", ".join(f"{one} (SHA-256 {key})" if one.endswith(".py") else one for one, key in unknown.items())
        raise ConfigError(
            f"{folder} would execute code that you have not trained with on this machine: {names}; if you have read it "
            "and trust it, add trust=true (in Python: load(path, trust=True)); otherwise give your own file with "
            "imports=PATH"
        )


@contextlib.contextmanager
def trusting(is_trusting: bool = True) -> Iterator[None]:
    """Allow the execution of all code in run folders inside of the context, if `is_trusting`."""
    global _is_trusting, _is_substituted  # noqa: PLW0603
    before = _is_trusting, _is_substituted
    _is_trusting = is_trusting or _is_trusting
    try:
        yield
    finally:
        _is_trusting, _is_substituted = before


def has_run(key: str, copy: Path, original: str) -> bool:
    """Return whether the code with this SHA-256 is what this process executes for an import of a run folder."""
    if key in have_run:
        return True
    return not _is_substituted and digest(copy) == key and digest(Path(original)) in (None, key)


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


def keep(imports: Sequence[str], run_dir: Path) -> Mapping[str, str]:
    """Copy user files and modules of one file into the run folder, and trust them from now on.

    Copies of a run that has started are kept. Returns the SHA-256 of each copy by name.
    """
    digests = {}
    has_started = (run_dir / "config.yaml").exists()
    for one, copy in zip(imports, _copies(imports, run_dir), strict=True):
        source = _source_file(one)
        if source and not (has_started and copy.exists()):
            copy.parent.mkdir(exist_ok=True)
            copy.write_bytes(source.read_bytes())
        if copy.exists():
            digests[copy.name] = _key(str(copy))
        trust([str(copy) if copy.exists() else one])
    return digests


def digest(path: Path) -> str | None:
    """Return the SHA-256 of a file; `None` if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def _source_file(one: str) -> Path | None:
    """Return the file of an import; `None` for a package, and for a file that does not exist."""
    if not one.endswith(".py"):
        if "." in one:
            return None
        spec = importlib.util.find_spec(one)
        one = spec.origin if spec and spec.origin and not spec.submodule_search_locations else ""
    return Path(one) if one.endswith(".py") and Path(one).exists() else None


def _copies(imports: Sequence[str], run_dir: Path) -> list[Path]:
    """Return the paths of the copies, numbered because several files may have the same name."""
    names = [Path(one).name if one.endswith(".py") else f"{one}.py" for one in imports]
    return [run_dir / "imports" / f"{number}-{name}" for number, name in enumerate(names)]


def _run(one: str) -> None:
    """Run a file or a module, once in a process."""
    try:
        key = _key(one)
        if key not in have_run:
            _run_file(Path(one), key) if one.endswith(".py") else importlib.import_module(one)
            have_run.add(key)
    except Exception as error:  # a user's file can raise anything
        raise ConfigError(f"cannot import {one}: {type(error).__name__}: {error}") from error


def _run_file(path: Path, key: str) -> None:
    """Run exactly the content with this digest, and never a compiled file beside it.

    Later imports can import it by its name, unless the name is taken.
    """
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != key:
        raise OSError("the file has just been changed")
    name, stem = f"imported_{key[:16]}", path.stem.split("-", 1)[-1]
    module = types.ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # annotations of classes are resolved there
    exec(compile(content, str(path), "exec"), module.__dict__)
    if stem not in sys.modules and importlib.util.find_spec(stem) is None:
        sys.modules[stem] = module


def _key(one: str) -> str:
    """Return the SHA-256 of a file, or the name of a module."""
    return hashlib.sha256(Path(one).read_bytes()).hexdigest() if one.endswith(".py") else one


@contextlib.contextmanager
def _without_working_directory() -> Iterator[None]:
    before = list(sys.path)
    sys.path[:] = [path for path in before if path and Path(path).resolve() != Path.cwd()]
    try:
        yield
    finally:
        sys.path[:] = before


def _state_file() -> Path | None:
    """Return the list of trusted digests; `None` for a user without a home directory."""
    try:
        home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(home) / "jaxswarm" / "trusted_imports.txt"


def _trusted() -> set[str]:
    path = _state_file()
    try:
        return set(path.read_text().split()) if path else set()
    except (OSError, ValueError):
        return set()


def trust(imports: Sequence[str]) -> None:
    """Add files and modules to the user's list; without a list that can be written, nothing is trusted later."""
    path = _state_file()
    new = {_key(one) for one in imports} - _trusted()
    if path and new:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "a") as file:
                file.write("".join(f"{key}\n" for key in sorted(new)))
