"""Work on many frames, shared between threads, and arrays for its results."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

_cores: int | None = None


def use_threads(count: int) -> None:
    """Set the number of threads of each product of torch and NumPy in this process.

    The last digits of products depend on it. A product waits for its slowest thread, which another
    process may delay, and most products here are too small to gain from a second thread.
    """
    torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")


def use_cores(count: int | None) -> None:
    """Share slices between so many threads of this process; None: as many as torch may use."""
    global _cores  # noqa: PLW0603
    _cores = count


def empty_aligned(*shape: int) -> NDArray[np.float64]:
    """Return an array in torch's memory, which has torch's alignment.

    The last digits of products depend on the alignment, and equal fits must be equal bytes.
    """
    array: NDArray[np.float64] = torch.empty(shape, dtype=torch.float64).numpy()
    return array


def in_slices(frames: int, size: int, work: Callable[[slice], object]) -> None:
    """Call `work` for slices of at most `size` frames, in as many threads as there may be.

    The result does not depend on the threads if `work` writes only to the frames of its slice.
    """
    parts = [slice(start, min(start + size, frames)) for start in range(0, frames, size)]
    threads = min(_cores or torch.get_num_threads(), len(parts))
    if threads <= 1:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, part) for part in parts]:
            done.result()
