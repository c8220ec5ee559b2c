"""Rollouts in MuJoCo C: of the bench's MJCF, or of `drive.py`, whose law may be the ONNX or the TorchScript file."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from given import Given, load_module, read_given

Step = Callable[[mujoco.MjData, int], None]


def main() -> None:
    """Simulate each rollout from its initial state."""
    given, options = read_given(__doc__, add_options)
    kind, packages = options.kind, ["mujoco"]
    if kind == "bench":
        qpos = roll(given, "mjcf", prepare_bench)
    else:
        module: Any = load_module(given.folder / "mujoco" / "drive.py")
        packages += use_law(module, given.folder, kind)
        qpos = roll(given, "mujoco", make_drive(module))
    given.write(qpos, *packages[::-1])


def add_options(parser: argparse.ArgumentParser) -> None:
    """What moves the bench."""
    parser.add_argument("--kind", choices=("bench", "drive", "onnx", "torchscript"), required=True)


def roll(given: Given, target: str, prepare: Callable[..., Step]) -> np.ndarray:
    """Positions after each sample, (batch, time, nv)."""
    found = []
    for rollout in range(len(given.qpos)):
        model = mujoco.MjModel.from_xml_string(given.bench(target, rollout))
        data, positions = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = given.qpos[rollout], given.qvel[rollout]
        step = prepare(given, model, data, rollout)
        for number in range(given.steps):
            step(data, number)
            positions.append(data.qpos.copy())
        found.append(positions)
    return given.sampled(np.array(found))


def prepare_bench(given: Given, model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> Step:
    """The MJCF as it is; the caller computes the controller of laws that have one, as `drive.py` says it."""
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    law = module.Actuator()
    for actuator in range(model.nu):
        if count := int(model.actuator_history[actuator, 0]):  # the file delays commands itself
            held, steps = given.before["ctrl"][rollout, :, actuator], np.arange(-count, 0)
            known = held[np.maximum(len(held) + steps, 0)]
            mujoco.mj_initCtrlHistory(model, data, actuator, model.opt.timestep * steps, known)
    driven = given.recorded if model.nhistory else given.acting

    def step(data: mujoco.MjData, number: int) -> None:
        signals = {name: signal[rollout, number] for name, signal in driven.items()}
        command = signals.pop("ctrl")
        data.ctrl[:] = law.control(np, module.ACTUATOR, data.qpos, data.qvel, command, signals)
        mujoco.mj_step(model, data)

    return step


def make_drive(module: Any) -> Callable[..., Step]:
    """The module, which brings friction, controller and delay."""

    def prepare(given: Given, model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> Step:
        drive = module.Drive(model)
        before = {name: signal[rollout] for name, signal in given.before.items()}
        drive.start_late(before.pop("ctrl"), before)

        def step(data: mujoco.MjData, number: int) -> None:
            signals = {name: signal[rollout, number] for name, signal in given.recorded.items()}
            drive.step(data, signals.pop("ctrl"), signals)

        return step

    return prepare


def use_law(module: Any, folder: Path, kind: str) -> list[str]:
    """Let the module ask an exported file for friction instead of its own formula; the package that runs it."""
    if kind == "onnx":
        import onnxruntime

        session = onnxruntime.InferenceSession(
            (folder / "onnx" / "friction.onnx").read_bytes(), providers=["CPUExecutionProvider"]
        )

        def terms(self: Any, xp: Any, values: Any, state: Any) -> Any:
            rows = {name: np.asarray(signal, float)[None] for name, signal in state._asdict().items()}
            return module.FrictionTerms(*(term[0] for term in session.run(None, rows)))

        module.Law.terms = terms
        return ["onnxruntime"]
    if kind == "torchscript":
        import torch

        law = torch.jit.load(folder / "torchscript" / "friction.pt")

        def terms(self: Any, xp: Any, values: Any, state: Any) -> Any:
            rows = [torch.tensor(np.asarray(signal, float))[None] for signal in state]
            return module.FrictionTerms(*(term[0].numpy() for term in law(*rows)))

        module.Law.terms = terms
        return ["torch"]
    return []


if __name__ == "__main__":
    main()
