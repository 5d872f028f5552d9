"""Registries of classes by name, which list their names if one is unknown."""

from typing import Any

from jaxswarm.config.schema import nearest


class Registry(dict[str, Any]):
    """A dict of classes by name. Looking up an unknown name raises a `KeyError` that lists the names."""

    def __init__(self, kind: str, classes: dict[str, Any]) -> None:
        super().__init__(classes)
        self.kind = kind

    def __missing__(self, name: Any) -> Any:
        """Raise a `KeyError` with the nearest name; called by `registry[name]` only."""
        near = nearest(name, list(self)) if isinstance(name, str) else ""
        raise KeyError(f"{self.kind}: must be one of {', '.join(self)}, got {name!r}{near}")
