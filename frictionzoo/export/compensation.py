"""Target `compensation`: a C header with the torque that cancels a drive's friction in its controller."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from frictionzoo import __version__
from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import DriveState
from frictionzoo.core.templates import open_template
from frictionzoo.export.base import Export, Target, list_values, measure, read_optional, register_target
from frictionzoo.export.c_source import run_compiled, write_literal, write_statements
from frictionzoo.export.graph import list_units
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.models import TorchFriction
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.simulation.fold import CannotSpecialiseError, specialise

FILE, FUNCTION, DESIRED = "friction_compensation.h", "friction_compensation", "desired_velocity"
GAIN = 0.95  # below 1, so that a joint with a few per cent less friction than identified stays passive
BAND = 0.01  # default dead band, as a share of the joint's highest recorded speed
MOST_OPERATIONS = 5000  # a compiler takes minutes for more, a microcontroller longer than a control step
_SPEEDS = (1e-3, 0.03, 0.3, 0.999, 1.001, 3.0)  # at which passivity is checked, in dead bands


@register_target("compensation")
class Compensation(Target):
    """C and C++ header without dependencies: the torque that cancels the drive's friction, for a real controller.

    The torque is a share of the identified friction at the measured velocity. Below the dead band the side of the
    friction fades from the measured into the desired velocity: the torque has no jump, and helps a joint to start.

    Source: H. Olsson, K. J. Astrom, C. Canudas de Wit, M. Gafvert, P. Lischinsky, "Friction models and friction
    compensation", European Journal of Control 4(3), 1998, section 5.
    """

    options: ClassVar[Mapping[str, str]] = {
        "gain": f"share of the friction to cancel, above 0 and up to 1; {GAIN} by default",
        "dead_band": "speed below which the desired velocity counts too; 1 % of a joint's highest speed by default",
        "limit": "largest torque; by default the largest friction in the recordings times the gain",
    }

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        if isinstance(fitted.model, TorchFriction):
            raise ExportError(f"{fitted.model.name}: it exists only in torch, expected a formula over xp; fit another")
        compensate = _Law(fitted, options)
        text, used = _write_header(fitted, compensate)
        write_atomically(folder / FILE, text.encode())
        samples = fitted.samples
        signals = samples.given() | {DESIRED: np.random.default_rng(0).permutation(samples.qvel)}
        inputs = np.concatenate([np.broadcast_to(signals[name], samples.qvel.shape) for name in used], axis=1)
        came = run_compiled((folder / FILE).read_text(), FUNCTION, inputs, fitted.bench.nv)
        expected = compensate(np, samples, signals[DESIRED])
        over = f"{len(expected)} recorded states in compiled C"
        return Export((FILE,), (measure("torque", fitted, came, expected, over),), compensate.say_limits())


class _Law:
    """Compensation of one drive's friction.

    Attributes:
        gain: Share of the friction to cancel.
        band: Dead band [rad/s or m/s] of each joint.
        limit: Largest torque [N m or N] of each joint.
        share: Largest share of its friction that a slow joint gets back; None for a model that may add energy.
    """

    def __init__(self, fitted: FittedDrive, options: Mapping[str, str]) -> None:
        samples, nv = fitted.samples, fitted.bench.nv
        gain, band, limit = (read_optional(options, name) for name in ("gain", "dead_band", "limit"))
        for name, value in (("gain", gain), ("dead_band", band), ("limit", limit)):
            if value is not None and (value <= 0 or (name == "gain" and value > 1)):
                upper = " and up to 1" if name == "gain" else ""
                raise ConfigError(f"{name}={value:g}; expected a number above 0{upper}; change it")
        self._fitted, self.gain = fitted, GAIN if gain is None else gain
        highest = BAND * np.abs(samples.qvel).max(axis=0)
        self.band = np.where(highest > 0, highest, BAND) if band is None else np.full(nv, band)
        self.limit = np.full(nv, np.inf if limit is None else limit)
        if limit is None:
            self.limit = np.abs(self(np, samples, samples.qvel)).max(axis=0)
        self.share = self._highest_share() if fitted.model.dissipative else None
        if self.share is not None and self.share > 1:
            raise ExportError(
                f"target=compensation: the torque is {self.share:.3g} times the friction at some speed, expected at "
                "most 1, or it drives the joint; set a smaller gain or another dead_band"
            )

    def __call__(self, xp: Any, state: DriveState, desired: Any) -> Any:
        """Return the torque of each joint, of shape (..., nv); `xp` is numpy or jax.numpy."""
        measured, wanted = (xp.clip(velocity / self.band, -1, 1) for velocity in (state.qvel, desired))
        side = measured + (1 - xp.abs(measured)) * wanted  # 1 forward, -1 backward
        speed = xp.maximum(xp.abs(state.qvel), self.band)
        # Viscous friction of the true speed, or the torque would exceed the breakaway torque of a joint at rest.
        forward, backward = (self.friction(xp, state._replace(qvel=way * speed), way, state.qvel) for way in (1, -1))
        return xp.clip(self.gain * ((1 + side) * forward + (1 - side) * backward) / 2, -self.limit, self.limit)

    def friction(self, xp: Any, state: DriveState, way: int, qvel: Any) -> Any:
        """Return the friction torque of joints that slide forward (1) or backward (-1), with damping at `qvel`."""
        model = self._fitted.model
        if xp is np:
            terms = evaluate_law(model, state)
        else:
            values = {name: xp.asarray(value) for name, value in self._fitted.values["friction"].items()}
            terms = model.terms(xp, values, state)
        torque, frictionloss, damping = (0.0 if term is None else term for term in terms)
        return torque + way * frictionloss + damping * qvel

    def _highest_share(self) -> float:
        """Return the largest share of its friction that a slow joint gets back, also when it starts from rest."""
        samples, shares = self._fitted.samples, list[float]()
        some = samples.map(lambda signal: np.asarray(signal)[:: max(1, len(samples.qvel) // 1000)])
        for way, factor in itertools.product((1, -1), _SPEEDS):
            state = some._replace(qvel=way * factor * self.band * np.ones(some.qvel.shape))
            friction = way * self.friction(np, state, way, state.qvel)
            # A law without frictionloss has no torque at rest that could hold a joint.
            for desired in (0.0, way * self.band) if self._fitted.model.constraint else (0.0,):
                given = way * self(np, state, desired * np.ones(some.qvel.shape))
                shares.append(float(np.max(given / np.maximum(friction, 1e-300))))
        return max(shares)

    def say_limits(self) -> tuple[str, ...]:
        """Describe accuracy and limits, a sentence each."""
        model, samples, units = self._fitted.model, self._fitted.samples, self._fitted.units
        forward, backward = (self.friction(np, samples, way, samples.qvel) for way in (1, -1))
        friction, moving = np.where(samples.qvel > 0, forward, backward), np.abs(samples.qvel) > self.band
        whole = np.square(friction)[moving].sum()
        left = np.square(friction - self(np, samples, samples.qvel))[moving].sum() / whole if whole else 1.0
        said = [
            f"Gain {self.gain:g}, dead band {list_values(self.band)} {units['velocity']}, limit "
            f"{list_values(self.limit)} {units['torque']}: {100 * (1 - np.sqrt(left)):.1f} % of the friction (RMS) is "
            "cancelled at the recorded states above the dead band.",
            "A controller with delay compensates late: it drives a joint for this time after each reversal. Use a "
            "smaller gain or a larger dead_band for a delay of several control steps.",
        ]
        if self.share is not None:
            share = f"At low speed at most {100 * self.share:.3g} % of the friction is cancelled"
            at_rest = "so the torque alone moves none" if model.constraint else "a start from rest was not checked"
            said.append(f"{share}; {at_rest}.")
        else:
            said.append(f"{model.name} may add energy, and so may the torque that cancels it.")
        if model.memory:
            said.append(f"{model.name} has memory: this is its friction at constant velocity, without presliding.")
        return tuple(said)


def _write_header(fitted: FittedDrive, compensate: _Law) -> tuple[str, list[str]]:
    """Return the header's text, and the names of its inputs in the order of its struct."""
    names, units = [*fitted.samples.given(), DESIRED], fitted.units

    def torque(*signals: Float[Any, "nv"]) -> Any:
        state = DriveState(**dict(zip(names[:-1], signals[:-1], strict=True)))
        return compensate(jnp, state, signals[-1])

    try:
        folded = specialise(torque, *(np.zeros(fitted.bench.nv) for _ in names))
    except CannotSpecialiseError as error:
        raise ExportError(f"{fitted.model.name}: its formula has {error}, which has no C form here") from error
    if folded.operations > MOST_OPERATIONS:
        raise ExportError(
            f"{fitted.model.name}: {folded.operations} scalar operations, expected at most {MOST_OPERATIONS} for a "
            "controller; distil it into a formula first, python -m frictionzoo.distill RUN model=NAME"
        )
    read, body = write_statements(folded, names, "torque")
    signal_units = list_units(fitted)[0] | {DESIRED: units["velocity"]}
    used = [name for name in names if name in {*read, "qvel", DESIRED}]
    text = open_template("export/compensation.h.jinja").render(
        version=__version__,
        gain=f"{compensate.gain:g}",
        band=list_values(compensate.band),
        limit=list_values(compensate.limit),
        torque_unit=units["torque"],
        velocity_unit=units["velocity"],
        joints=[write_literal(name) for name in fitted.bench.joints],
        fields={name: signal_units[name] for name in used},
        body=body,
    )
    return text, used
