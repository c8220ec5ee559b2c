"""JAX configuration of one identification, restored afterwards."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import jax
from jax._src import xla_bridge  # JAX has no public name for whether it has begun
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from frictionzoo.core.errors import ConfigError
from frictionzoo.data.cache import cache_folder

_forked_late: list[bool] = []
"""Filled in a process forked after JAX had begun to compute: JAX's threads are missing there."""


def _note_fork() -> None:
    if xla_bridge.backends_are_initialized():
        _forked_late.append(True)


os.register_at_fork(after_in_child=_note_fork)  # not called for another program
_SHORTEST = 0.1  # shortest compilation whose result is stored [s]


@contextlib.contextmanager
def computing(dtype: str, device: str = "auto", compilation_cache: str | None = "user") -> Iterator[str]:
    """Compute in this precision, on this device, with a cache of compiled functions; yield the device's name.

    `dtype` is `float32` or `float64`; `device` is `auto`, `cpu` or `cuda`; `compilation_cache` is as in `cache_folder`,
    but JAX's setting takes precedence.

    Raises:
        ConfigError: An argument is unknown, JAX finds no such device, or the process was forked after JAX had begun to
            compute.
    """
    refuse_late_fork()
    # Else XLA reserves most of the GPU's memory and leaves torch none; it reads this when it first uses the GPU.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    refuse_precision(dtype)
    if device not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device={device}; expected auto, cpu or cuda")
    try:
        chosen = jax.devices(None if device == "auto" else device)[0]
    except RuntimeError:
        raise ConfigError(
            f"device={device}: JAX finds none, expected a GPU; install frictionzoo[cuda] or set device=cpu"
        ) from None
    folder = cache_folder(compilation_cache)
    with jax.enable_x64(dtype == "float64"), jax.default_device(chosen), _keeping(folder):
        yield str(chosen.device_kind if chosen.platform != "cpu" else "cpu")


def refuse_late_fork() -> None:
    """Refuse to compute in a process forked after JAX had begun, where it would hang: ConfigError."""
    if _forked_late:
        raise ConfigError(
            "this process was forked after JAX had begun to compute, where it would hang; expected one of its own: use "
            "multiprocessing.get_context('spawn'), or fork before the first fit or rollout"
        )


def refuse_precision(dtype: str) -> None:
    """Refuse a precision that is neither `float32` nor `float64`: ConfigError."""
    if dtype not in ("float32", "float64"):
        raise ConfigError(f"dtype={dtype}; expected float32 or float64")


@contextlib.contextmanager
def _keeping(folder: Path | None) -> Iterator[None]:
    """Store compiled functions below this folder."""
    if folder is None or jax.config.jax_compilation_cache_dir is not None:
        yield
        return
    options = {
        "jax_compilation_cache_dir": str(folder / "xla"),
        "jax_persistent_cache_min_compile_time_secs": _SHORTEST,
    }
    previous = {name: getattr(jax.config, name) for name in options}
    try:
        _configure(options)
        yield
    finally:
        _configure(previous)


def _configure(options: dict[str, object]) -> None:
    for name, value in options.items():
        jax.config.update(name, value)
    jax_cache.reset_cache()  # JAX reads the folder once, at its first compilation
