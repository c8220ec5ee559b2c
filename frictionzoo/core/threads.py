"""CPU threads: how many a job may take, so that jobs beside each other do not fight over cores."""

import logging
import os
import sys

from frictionzoo.core.errors import ConfigError

_log = logging.getLogger(__name__)

MOST_THREADS = 1024  # more than any machine has cores; that many are started
# Read once, by XLA's pool for the CPU, torch, and the libraries under numpy and scipy, when each is loaded.
_VARIABLES = ("PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def count_cores() -> int:
    """Cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_threads() -> int:
    """Threads that this process may take, by its cores and by what `limit_threads` has set."""
    limit = os.environ.get(_VARIABLES[0], "")
    return min(count_cores(), int(limit)) if limit.isdigit() and int(limit) else count_cores()


def threads_each(threads: int | None) -> int:
    """Threads of one job where several run at a time: what the option `threads` asks for, else one."""
    return threads or 1


def jobs_at_once(threads: int | None) -> int:
    """How many jobs run at a time on this machine, so that jobs x threads = cores."""
    return max(1, count_cores() // threads_each(threads))


def limit_threads(threads: int | None) -> None:
    """Limit the CPU threads of this process, None for no limit; takes effect if torch and JAX are not loaded yet.

    Raises:
        ConfigError: Less than one.
    """
    if threads is None:
        return
    if not 1 <= threads <= MOST_THREADS:
        raise ConfigError(f"threads={threads}; expected 1 or more and at most {MOST_THREADS}, or null for all cores")
    wanted = str(threads)
    if "jax" in sys.modules and os.environ.get(_VARIABLES[0]) != wanted:
        _log.warning("threads=%s comes too late: what the first job of this process took holds for all", wanted)
        return
    os.environ.update(dict.fromkeys(_VARIABLES, wanted))
