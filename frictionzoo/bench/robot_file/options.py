"""Options of a robot's file in a bench, with a note for each that the bench drops."""

import xml.etree.ElementTree as ET
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
_HARMFUL = {
    "frictionloss": "it would switch off the friction that is identified",
    "actuation": "it would switch off the drives",
}


def acting(source: Source, kind: str) -> bool:
    """Return whether the file's flags enable a kind of constraints (`equality`, `limit`, `contact`)."""
    off = _OFF.mjDSBL_CONSTRAINT | getattr(_OFF, f"mjDSBL_{kind.upper()}")
    return not source.model.opt.disableflags & off


def is_fluid(source: Source) -> bool:
    """Return whether bodies move through a medium."""
    return bool(source.model.opt.density > 0 or source.model.opt.viscosity > 0)


def write_option(source: Source, contacts: bool) -> ET.Element:
    """Return the `<option>` of a bench; differences from the file are noted."""
    option, default = source.model.opt, mujoco.MjOption()
    values = {"timestep": option.timestep, "gravity": option.gravity}
    attributes = {"integrator": _integrator(source)}
    if is_fluid(source):
        values |= {"density": option.density, "viscosity": option.viscosity, "wind": option.wind}
        source.note(f"kept: a medium of {option.density:g} kg/m^3 and {option.viscosity:g} Pa s around all bodies")
        if source.model.geom_fluid[:, 0].any():
            source.fail("fluidshape of geoms, which is not supported; remove it, or option density and viscosity")
    elif (option.wind != 0).any():
        source.note("option wind left out: there is no medium")
    if contacts:
        values["impratio"] = option.impratio
        attributes["cone"] = "elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal"
    else:
        changed = [name for name in ("cone", "impratio") if getattr(option, name) != getattr(default, name)]
        source.note("contact options left out: {}", changed)
    solver = ("solver", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "noslip_iterations", "jacobian")
    changed = [f"{n}={getattr(option, n):g}" for n in solver if getattr(option, n) != getattr(default, n)]
    source.note("options of the solver left out ({}): friction is solved to MuJoCo's default accuracy", changed)
    source.note("flags left out: {}", _list_set(mujoco.mjtEnableBit, "mjENBL_", option.enableflags))
    element = ET.Element("option", {name: in_full(value) for name, value in values.items()} | attributes)
    if flags := _flags(source, contacts):
        ET.SubElement(element, "flag", dict.fromkeys(flags, "disable"))
    return element


def _integrator(source: Source) -> str:
    integrator = _INTEGRATOR(source.model.opt.integrator)
    explicit = integrator in (_INTEGRATOR.mjINT_EULER, _INTEGRATOR.mjINT_RK4) or is_fluid(source)
    chosen, name = "Euler" if explicit else "implicitfast", integrator.name.removeprefix("mjINT_")
    if name.lower() != chosen.lower():
        source.note(f"integrator {name}: {chosen} instead, the only one of the engines here")
    return chosen


def _list_set(bits: Any, prefix: str, value: int) -> list[str]:
    """Return the names of the flags that are set in a value, as the MJCF has them."""
    flags = {name: flag for name, flag in bits.__members__.items() if name.startswith(prefix)}
    return [name.removeprefix(prefix).lower() for name, flag in flags.items() if value & flag]


def _flags(source: Source, contacts: bool) -> list[str]:
    """Return the names of the flags that stay disabled; others are noted."""
    off = _list_set(_OFF, "mjDSBL_", source.model.opt.disableflags)
    kept = _KEPT_FLAGS | ({"filterparent"} if contacts else set())
    for flag, reason in _HARMFUL.items():
        source.note(f"flag {{}}=disable left out: {reason}", [flag] if flag in off else [])
    absent = [flag for flag in off if flag in _ASKED]
    source.note("flags {}=disable: the bench does not contain these effects", absent)
    assert not set(off) - _KEPT_FLAGS - _ASKED - _IDLE - set(_HARMFUL) - {"filterparent", "clampctrl"}, off
    return [flag for flag in off if flag in kept]
