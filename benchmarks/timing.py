"""What the benchmarks share: words in, lines of JSON out, times of calls, the speed of the machine, memory."""

import json
import resource
import statistics
import time

import jax

from jaxswarm.host import manifest


def settings(overrides: list[str], **defaults: str) -> dict[str, str]:
    """The values of `key=value` words over the defaults; a `ValueError` says which keys there are."""
    for word in overrides:
        key, equals, _ = word.partition("=")
        if not equals or key not in (*defaults, "out"):
            raise ValueError(
                f"{word} is not possible; accepted: {', '.join(f'{key}=...' for key in (*defaults, 'out'))}"
            )
    return {"out": ""} | defaults | dict(word.split("=", 1) for word in overrides)


def report(result: dict, out: str = "") -> None:
    """Prints the result as a line of JSON, to four digits and with where it was measured, and appends it to a file."""
    rounded = json.loads(json.dumps(result), parse_float=lambda x: float(f"{float(x):.4g}"))
    line = json.dumps(rounded | manifest.provenance())
    print(line, flush=True)
    if out:
        with open(out, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def seconds(function, *args, repeats: int) -> float:
    """Median time of a call, after one that does not count."""
    jax.block_until_ready(function(*args))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def peak_memory() -> float:
    """MiB: of the device where it tells, else of this process."""
    statistics_of_device = jax.local_devices()[0].memory_stats() or {}
    in_bytes = statistics_of_device.get("peak_bytes_in_use", 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return in_bytes / 2**20


def gemm_flops() -> float:
    """FLOP/s of a product of 2048 x 2048 matrices, float32."""
    matrix = jax.random.normal(jax.random.key(3), (2048, 2048))
    return 2 * 2048**3 / seconds(jax.jit(lambda x: x @ x), matrix, repeats=9)
