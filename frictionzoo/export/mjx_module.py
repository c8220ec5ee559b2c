"""Target `mjx`: a Python module with the friction model inside MJX's step."""

from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import mjx

from frictionzoo.core.state import Signals
from frictionzoo.core.templates import Code
from frictionzoo.export.base import Export, Target, measure, register_target
from frictionzoo.export.module import BENCH, MODULE, load_module, write_drive
from frictionzoo.export.simulate import PAYLOADS, commands_before
from frictionzoo.result.fitted_drive import FittedDrive


@register_target("mjx")
class Mjx(Target):
    """Python module with the exact friction model inside MJX's step; needs only jax and mujoco-mjx."""

    packages: ClassVar[tuple[str, ...]] = ("mujoco", "jax", "numpy")

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        # MJX allocates friction constraints only for joints with frictionloss > 0; each step sets their values.
        loss = np.array(fitted.model.constrained, float) if fitted.model.constraint else None
        late = Code("commands are delayed." if "delay" in fitted.values["bench"] else "there is no delay.")
        written = write_drive(fitted, folder, "mjx_drive.py.jinja", loss, late_remark=late)
        with jax.enable_x64(True):
            difference = measure("qpos", fitted, _run(folder, fitted), fitted.rollout()[0])
        limit = "The difference is in 64 bits (jax_enable_x64); JAX's default of 32 bits rounds more."
        return Export(written, (difference,), (limit, *([PAYLOADS] if fitted.bench.payload is not None else [])))


def _run(folder: Path, fitted: FittedDrive) -> Float[np.ndarray, "batch time nv"]:
    module: Any = load_module(folder / MODULE)
    model = mujoco.MjModel.from_xml_path(str(folder / BENCH))
    segments, has_memory = fitted.segments, fitted.model.memory > 0

    def act(before: Signals, signals: Signals) -> tuple[Any, Any, Mapping[str, Any]]:
        now = Signals(signals.ctrl, {name: signals.inputs[name] for name in before.inputs})
        before = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), before, now)
        delayed = before.map(lambda command: module.late(command, fitted.timestep))
        return before, delayed.ctrl, signals.inputs | delayed.inputs | signals.observed

    @jax.jit
    def rollout(model: mjx.Model, data: mjx.Data, driven: tuple[Signals, Signals]) -> Any:
        def step(state: tuple[Any, ...], signals: Signals) -> tuple[Any, Any]:
            before, *drive = state
            before, *acting = act(before, signals)
            drive = module.step(model, *drive, *acting)
            data, *memory = drive if has_memory else (drive,)
            return (before, data, *memory), data.qpos

        now, before = driven
        memory = [module.reset(model, data, *act(before, now.map(itemgetter(0)))[1:])] if has_memory else []
        return jax.lax.scan(step, (before, data, *memory), now)[1]

    positions = []
    for number in range(segments.count):
        if segments.load is not None:
            fitted.bench.put_load(model, segments.load[number])
        on_device = mjx.put_model(model)
        data = mjx.make_data(on_device)
        data = data.replace(qpos=jnp.asarray(segments.qpos[number, 0]), qvel=jnp.asarray(segments.qvel[number, 0]))
        positions.append(
            np.asarray(rollout(on_device, data, _signals(fitted, number, module.steps_kept(fitted.timestep))))
        )
    substeps = fitted.sampling.substeps
    return np.stack(positions)[:, substeps - 1 :: substeps]


def _signals(fitted: FittedDrive, number: int, kept: int) -> tuple[Signals, Signals]:
    """Return the signals of each step of a rollout, and the commands in the `kept` steps before it."""
    now = fitted.acting(late=False).map(lambda signal: jnp.asarray(signal[number].reshape(-1, fitted.bench.nv)))
    commands = commands_before(fitted, number)
    return now, commands.map(
        lambda command: jnp.asarray(np.concatenate([np.repeat(command[:1], kept, axis=0), command])[-kept:])
    )
