"""Options of a robot's file in a bench, with a note for each that the bench drops."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any

import mujoco

from frictionzoo.bench.robot_file.source import Source
from frictionzoo.bench.template import in_full

_INTEGRATOR, _OFF = mujoco.mjtIntegrator, mujoco.mjtDisableBit
_KEPT_FLAGS = {"gravity", "spring", "damper", "eulerdamp", "refsafe"}
_ASKED = {"constraint", "equality", "limit", "contact"}
"""Flags of constraint types that the bench omits if disabled."""
_IDLE = {"warmstart", "sensor", "midphase", "autoreset", "nativeccd", "island", "multiccd"}
"""Flags without an effect on a bench's motion."""


def acting(source: Source, kind: str) -> bool:
    """Return whether the file's flags enable a kind of constraints (`equality`, `limit`, `contact`)."""
    off = _OFF.mjDSBL_CONSTRAINT | getattr(_OFF, f"mjDSBL_{kind.upper()}")
    return not source.model.opt.disableflags & off


def is_fluid(source: Source) -> bool:
    """Return whether bodies move through a medium."""
    return bool(source.model.opt.density > 0 or source.model.opt.viscosity > 0)


def write_option(source: Source, timestep: float | None, contacts: bool) -> ET.Element:
    """Return the `<option>` of a bench; differences from the file are noted."""
    option = source.model.opt
    values = {"timestep": option.timestep if timestep is None else timestep, "gravity": option.gravity}
    attributes = {"integrator": _integrator(source)}
    if is_fluid(source):
        values |= {"density": option.density, "viscosity": option.viscosity, "wind": option.wind}
        source.notes.append(
            f"kept: a medium of {option.density:g} kg/m^3 and {option.viscosity:g} Pa s around all bodies"
        )
        if source.model.geom_fluid[:, 0].any():
            source.fail("fluidshape of geoms, which is not supported; remove it, or option density and viscosity")
    if contacts:
        values["impratio"] = option.impratio
        attributes["cone"] = "elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal"
    source.notes += [*_say_solver(option), *_say_contact_options(option, contacts)]
    element = ET.Element("option", {name: in_full(value) for name, value in values.items()} | attributes)
    flags = _flags(source, contacts)
    if flags:
        ET.SubElement(element, "flag", dict.fromkeys(flags, "disable"))
    return element


def _integrator(source: Source) -> str:
    option, euler = source.model.opt, "Euler"
    chosen = {_INTEGRATOR.mjINT_EULER: euler, _INTEGRATOR.mjINT_RK4: euler}.get(
        _INTEGRATOR(option.integrator), "implicitfast"
    )
    chosen = euler if is_fluid(source) else chosen
    name = _INTEGRATOR(option.integrator).name.removeprefix("mjINT_")
    if name.lower() != chosen.lower():
        source.notes.append(f"integrator {name}: {chosen} instead, the only one of the engines here")
    return chosen


def _say_solver(option: mujoco.MjOption) -> Iterator[str]:
    default = mujoco.MjOption()
    names = ("solver", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "noslip_iterations", "jacobian")
    changed = [name for name in names if getattr(option, name) != getattr(default, name)]
    if changed:
        listing = ", ".join(f"{name}={getattr(option, name):g}" for name in changed)
        yield f"options of the solver left out ({listing}): friction is solved to MuJoCo's default accuracy"


def _say_contact_options(option: mujoco.MjOption, contacts: bool) -> Iterator[str]:
    default = mujoco.MjOption()
    changed = [name for name in ("cone", "impratio") if getattr(option, name) != getattr(default, name)]
    if changed and not contacts:
        yield f"contact options left out: {', '.join(changed)}"
    if (option.wind != 0).any() and not (option.density > 0 or option.viscosity > 0):
        yield "option wind left out: there is no medium"
    flags = _list_set(mujoco.mjtEnableBit, "mjENBL_", option.enableflags)
    if flags:
        yield f"flags left out: {', '.join(flags)}"


def _list_set(bits: Any, prefix: str, value: int) -> list[str]:
    """Return the names of the flags that are set in a value, as the MJCF has them."""
    flags = {name: flag for name, flag in bits.__members__.items() if name.startswith(prefix)}
    return [name.removeprefix(prefix).lower() for name, flag in flags.items() if value & flag]


def _flags(source: Source, contacts: bool) -> list[str]:
    """Return the names of the flags that stay disabled; others are noted."""
    off = _list_set(_OFF, "mjDSBL_", source.model.opt.disableflags)
    kept = _KEPT_FLAGS | ({"filterparent"} if contacts else set())
    reasons = {
        "frictionloss": "it would switch off the friction that is identified",
        "actuation": "it would switch off the drives",
    }
    source.notes += [f"flag {flag}=disable left out: {reasons[flag]}" for flag in off if flag in reasons]
    absent = [flag for flag in off if flag in _ASKED]
    if absent:
        source.notes.append(f"flags {', '.join(absent)}=disable: the bench does not contain these effects")
    assert not set(off) - _KEPT_FLAGS - _ASKED - _IDLE - set(reasons) - {"filterparent", "clampctrl"}, off
    return [flag for flag in off if flag in kept]
