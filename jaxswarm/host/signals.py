"""Signals that ask a training run to stop."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

_received: list[int] = []  # signals of the latest `stop_requests`


def exit_code() -> int:
    """Return the exit code after the latest training: 128 + the number of the signal that stopped it, or 0."""
    return 128 + _received[0] if _received else 0


@contextlib.contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """Yield an event that SIGTERM and the first Ctrl-C set; the second Ctrl-C interrupts as usual.

    Outside of the main thread, which alone may handle signals, the event is never set.
    """
    stop = threading.Event()
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def request(number: int, _: Any) -> None:
        stop.set()
        _received.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        text = f"\n{signal.Signals(number).name}: finishing the current updates; press Ctrl-C again to abort at once\n"
        os.write(sys.stderr.fileno(), text.encode())  # the signal may have interrupted a print

    for number in before:
        signal.signal(number, request)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
