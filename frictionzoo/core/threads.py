"""Limits on the CPU threads of a job, so that parallel jobs do not compete for cores."""

import logging
import os
import sys

from frictionzoo.core.errors import ConfigError

_log = logging.getLogger(__name__)

MOST_THREADS = 1024  # above the cores of any machine; this many threads would start
# Read once, when XLA's CPU pool, torch, and the libraries below numpy and scipy are loaded.
_VARIABLES = ("PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def count_cores() -> int:
    """Return the number of cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_threads() -> int:
    """Return the number of threads this process may use: its cores, or fewer after `limit_threads`."""
    limit = os.environ.get(_VARIABLES[0], "")
    return min(count_cores(), int(limit)) if limit.isdigit() and int(limit) else count_cores()


def threads_each(threads: int | None) -> int:
    """Return the threads of one job when several run in parallel: the option `threads`, else one."""
    return threads or 1


def jobs_at_once(threads: int | None) -> int:
    """Return how many jobs run in parallel on this machine, so that jobs x threads = cores."""
    return max(1, count_cores() // threads_each(threads))


def limit_threads(threads: int | None) -> None:
    """Limit the CPU threads of this process, before torch and JAX are loaded; None for no limit.

    Raises:
        ConfigError: Fewer than one, or more than `MOST_THREADS`.
    """
    if threads is None:
        return
    if not 1 <= threads <= MOST_THREADS:
        raise ConfigError(f"threads={threads}; expected 1 or more and at most {MOST_THREADS}, or null for all cores")
    wanted = str(threads)
    if "jax" in sys.modules and os.environ.get(_VARIABLES[0]) != wanted:
        _log.warning("threads=%s has no effect: the first job of this process set the number for all", wanted)
        return
    os.environ.update(dict.fromkeys(_VARIABLES, wanted))
