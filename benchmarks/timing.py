"""Shared parts of the benchmarks: help, overrides, JSON output, timing, machine speed and memory."""

import json
import resource
import statistics
import sys
import time
from collections.abc import Sequence

import jax

from jaxswarm.host import manifest


def help_if_asked(arguments: Sequence[str]) -> None:
    """Print the docstring of the benchmark and exit, if the user asks for help."""
    if {"-h", "--help", "help"} & set(arguments):
        print(sys.modules["__main__"].__doc__)
        raise SystemExit(0)


def settings(overrides: Sequence[str], **defaults: str) -> dict[str, str]:
    """Return the defaults with the values of `key=value` overrides; print help and exit if the user asks for it.

    Raises a `ValueError` that lists the keys if an override has no value or an unknown key.
    """
    help_if_asked(overrides)
    keys = (*defaults, "out")
    for override in overrides:
        key, equals, _ = override.partition("=")
        if not equals or key not in keys:
            raise ValueError(f"overrides: must be key=value with one of the keys {', '.join(keys)}, got {override}")
    return {"out": ""} | defaults | dict(override.split("=", 1) for override in overrides)


def report(result: dict, out: str = "") -> None:
    """Print the result as one line of JSON, and append it to the file `out` if one is given.

    Numbers are rounded to four digits. The line also has the versions, the device and the revision of the code.
    """
    rounded = json.loads(json.dumps(result), parse_float=lambda x: float(f"{float(x):.4g}"))
    line = json.dumps(rounded | manifest.provenance())
    print(line, flush=True)
    if out:
        with open(out, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def seconds(function, *args, repeats: int) -> float:
    """Return the median time of a call in seconds, after one call that is not timed."""
    jax.block_until_ready(function(*args))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def peak_memory() -> float:
    """Return the peak memory in MiB, of the device if it reports memory, otherwise of this process."""
    device_memory = jax.local_devices()[0].memory_stats() or {}
    in_bytes = device_memory.get("peak_bytes_in_use", 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return in_bytes / 2**20


def gemm_flops() -> float:
    """Measure the FLOP/s of a product of two 2048 x 2048 matrices in float32."""
    matrix = jax.random.normal(jax.random.key(3), (2048, 2048))
    return 2 * 2048**3 / seconds(jax.jit(lambda x: x @ x), matrix, repeats=9)
