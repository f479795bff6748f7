"""Worker processes of this machine, for batches."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, ClassVar

import jax
from loky import get_reusable_executor

# Environment of a worker of `Processes`: one thread each for XLA, the tree search and BLAS, and no accelerator, three
# quarters of whose memory each would reserve. loky would take memory that grows with the clouds for a leak, and start
# another worker. glibc would return the memory of large arrays to the system and get it again page by page, which took
# 6 % of the time of gradients: it keeps arrays of up to 32 MiB, its limit, and 128 MiB in all.
_ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18",
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(128 << 20),
}
# Settings of JAX for a whole process, which may differ from the environment. `with_settings` sends the others.
_SETTINGS = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
# Seconds between looks of a worker at its parent.
_LOOK = 1.0


class Processes(Executor):
    """Single-threaded workers in other processes, from loky: they need no `__main__` guard, and wait for further calls
    until the interpreter ends. All batches of this process share them."""

    # Chunks of all batches that have not ended, with their batches.
    _unfinished: ClassVar[dict[Future[Any], Processes]] = {}
    # Whether workers of this process have compiled, and wait for more.
    are_warm: ClassVar[bool] = False

    def __init__(self, num_workers: int):
        values = {name.upper(): getattr(jax.config, name) for name in _SETTINGS}
        environment = _ENVIRONMENT | {name: str(value) for name, value in values.items() if value is not None}
        begin = {"initializer": _begin_worker, "initargs": (os.getpid(),), "env": environment}
        self._current = partial(get_reusable_executor, num_workers, timeout=None, **begin)
        self._pool, self.num_workers = self._current(), num_workers
        # Or else this would begin beside the first worker, and let Ctrl-C through.
        resource_tracker.ensure_running()

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        # loky starts workers here, and later one for each that has died. Processes that start while Ctrl-C waits never
        # get it, so they do not report it either. Windows has no such mask.
        set_mask: Any = getattr(signal, "pthread_sigmask", None)
        before = set_mask and set_mask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            future = self._pool.submit(function, *arguments, **named)
        except RuntimeError:
            # A worker died, or another batch that ended early has ended the workers.
            self._pool = self._current()
            future = self._pool.submit(function, *arguments, **named)
        finally:
            if set_mask:
                set_mask(signal.SIG_SETMASK, before)
        self._unfinished[future] = self
        future.add_done_callback(self._unfinished.pop)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel the futures of this batch, if so wanted. Those in loky's queue cannot be cancelled: the workers are
        ended instead, unless they are at work for another batch."""
        if not cancel_futures:
            return
        unfinished = dict(self._unfinished)
        # Ended workers fail all futures, which loky cannot do to cancelled ones.
        if all(batch is self for batch in unfinished.values()):
            self._pool.shutdown(wait, kill_workers=True)
            Processes.are_warm = False
        for future, batch in unfinished.items():
            if batch is self:
                future.cancel()


def _begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end when it does, even if it is killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
