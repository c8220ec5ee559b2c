"""Rollouts in MuJoCo C of the bench's MJCF or of `drive.py`, optionally with the ONNX or TorchScript model."""

import argparse
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from given import Given, load_module, read_given
from native import Running, compile_program

Step = Callable[[mujoco.MjData, int], None]
Evaluate = Callable[[Sequence[np.ndarray]], Sequence[np.ndarray]]
"""Function from the friction model's inputs to its outputs, each with one number per joint."""


def main() -> None:
    """Simulate each rollout from its initial state."""
    given, options = read_given(__doc__, add_options)
    versions = {}
    if options.kind == "bench":
        qpos = roll(given, "mjcf", prepare_bench)
    else:
        module: Any = load_module(given.folder / "mujoco" / "drive.py")
        if options.kind in LAWS:
            evaluate, versions = LAWS[options.kind](given)
            use_law(module, evaluate)
        qpos = roll(given, "mujoco", make_drive(module))
    given.write(qpos, "mujoco", **versions)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for what moves the bench."""
    parser.add_argument("--kind", choices=("bench", "drive", *LAWS), required=True)


def roll(given: Given, target: str, prepare: Callable[..., Step]) -> np.ndarray:
    """Return the positions after each sample, (batch, time, nv)."""
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
    """Return the step of the unchanged MJCF; the caller computes the controller, if any, as in `drive.py`."""
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
    """Return a function that prepares the module's step, with its friction, controller and delay."""

    def prepare(given: Given, model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> Step:
        drive = module.Drive(model)
        before = {name: signal[rollout] for name, signal in given.before.items()}
        drive.start_late(before.pop("ctrl"), before)

        def step(data: mujoco.MjData, number: int) -> None:
            signals = {name: signal[rollout, number] for name, signal in given.recorded.items()}
            drive.step(data, signals.pop("ctrl"), signals)

        return step

    return prepare


def use_law(module: Any, evaluate: Evaluate) -> None:
    """Replace the module's friction formula with `evaluate`."""

    def terms(self: Any, xp: Any, values: Any, state: Any) -> Any:
        return module.FrictionTerms(*evaluate([np.asarray(signal, float) for signal in state]))

    module.Law.terms = terms


def load_onnx(given: Given) -> tuple[Evaluate, dict[str, str]]:
    """Load the friction model in ONNX Runtime; return it with the runtime's version."""
    import onnxruntime

    content = (given.folder / "onnx" / "friction.onnx").read_bytes()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]

    def evaluate(state: Sequence[np.ndarray]) -> list[np.ndarray]:
        rows = {name: signal[None] for name, signal in zip(names, state, strict=True)}
        return [term[0] for term in session.run(None, rows)]

    return evaluate, {"onnxruntime": version("onnxruntime")}


def load_torchscript(given: Given) -> tuple[Evaluate, dict[str, str]]:
    """Load the friction model in `torch.jit`; return it with the version of torch."""
    import torch

    law = torch.jit.load(given.folder / "torchscript" / "friction.pt")

    def evaluate(state: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [term[0].numpy() for term in law(*(torch.tensor(signal)[None] for signal in state))]

    return evaluate, {"torch": version("torch")}


def load_libtorch(given: Given) -> tuple[Evaluate, dict[str, str]]:
    """Start the friction model in a C++ program built with PyTorch's libtorch; return it with the reported version."""
    program, joints = given.out.with_suffix(".law"), len(given.joints)
    compile_law(program)
    law = Running([program, given.folder / "torchscript" / "friction.pt", str(joints)])

    def evaluate(state: Sequence[np.ndarray]) -> list[np.ndarray]:
        return list(law.ask(np.stack(state), 3, joints))  # torque, frictionloss, damping

    return evaluate, {"libtorch": law.version}


def compile_law(program: Path) -> None:
    """Compile `law.cpp`."""
    found = find_spec("torch")
    assert found is not None and found.origin is not None
    torch = Path(found.origin).parent
    headers = [torch / "include", torch / "include" / "torch" / "csrc" / "api" / "include"]
    flags = [f"-L{torch / 'lib'}", *(f"-I{folder}" for folder in headers), f"-Wl,-rpath,{torch / 'lib'}"]
    compile_program("law.cpp", program, [*flags, "-ltorch", "-ltorch_cpu", "-lc10"])


LAWS = {"onnx": load_onnx, "torchscript": load_torchscript, "libtorch": load_libtorch}
"""Loader of each kind of exported friction model."""


if __name__ == "__main__":
    main()
