"""Settings of Matplotlib that do not depend on the user's: a `matplotlibrc` must not change or break our plots."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any


@contextlib.contextmanager
def plot_settings(settings: Mapping[Any, Any] | None = None) -> Iterator[None]:
    """Use Matplotlib's defaults and these settings inside of the context, and the user's settings again after it."""
    from matplotlib import rc_context, rcdefaults, rcParams  # noqa: PLC0415

    with rc_context():
        rcdefaults()
        for name, value in (settings or {}).items():
            rcParams[name] = value
        yield
