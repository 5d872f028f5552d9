"""What the benchmarks share: times of calls, the speed of the machine, memory."""

import resource
import statistics
import time

import jax


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
