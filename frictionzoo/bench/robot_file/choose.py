"""Selection of joints in a robot's file."""

import re
from collections.abc import Sequence

import mujoco

from frictionzoo.bench.robot_file.source import Source, listed
from frictionzoo.core.errors import BenchError, closest

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
}


def choose_joints(source: Source, joint: str | int | Sequence[str | int] | None) -> list[int]:
    """Return the indices of the joints with these names or regular expressions of whole names, in MuJoCo's order.

    Raises:
        BenchError: A name or pattern matches no joint, the names are not in the file's order, or no joint is selected.
    """
    kinds = {index: _KINDS[int(kind)] for index, kind in enumerate(source.model.jnt_type)}
    names = {source.model.joint(index).name: index for index, kind in kinds.items() if kind in ("hinge", "slide")}
    if joint is None:
        if "" in names:
            source.fail("it has joints without a name, expected a name for each; list the joints in bench.joint")
        wanted = [".*"]
    else:
        # The command line parses a name such as 0 as a number.
        wanted = [str(name) for name in ([joint] if isinstance(joint, str | int) else joint)]
    if not names or not wanted:
        source.fail(
            "no hinge and no slide is chosen, expected joints that move; set bench.joint, or another bench.mjcf"
        )
    for name in wanted:
        if name not in names and not _matching(name, names):
            indices = [index for index in kinds if source.model.joint(index).name == name]
            problem = (
                f"joint {name} is a {kinds[indices[0]]} joint, expected a hinge or a slide"
                if indices
                else f"no joint {name}"
            )
            source.fail(f"{problem}; {closest(name, filter(None, names))}; set bench.joint")
    exact = [name for name in wanted if name in names]
    ordered = [name for name in names if name in exact]
    if exact != ordered:
        # The recording's columns follow bench.joint: another order would silently swap the joints.
        raise BenchError(
            f"bench.joint=[{', '.join(exact)}]: expected each joint once in the order of {source.path}, "
            f"[{', '.join(ordered)}]; change it, and data.columns with it"
        )
    return sorted({index for name in wanted for index in ([names[name]] if name in names else _matching(name, names))})


def _matching(pattern: str, names: dict[str, int]) -> list[int]:
    try:
        return [index for name, index in names.items() if name and re.fullmatch(pattern, name)]
    except re.error:
        return []


def say_fixed(source: Source, joints: Sequence[int], base: str, others: str) -> None:
    """Note the fixed joints, or refuse to fix them.

    Raises:
        BenchError: A joint would be fixed, and `base` or `others` is `as_is`.
    """
    model, fixed = source.model, [index for index in range(source.model.njnt) if index not in joints]
    bases = [index for index in fixed if _KINDS[int(model.jnt_type[index])] == "free"]
    unchosen = [index for index in fixed if index not in bases]
    if bases:
        bodies = listed([source.name(int(model.jnt_bodyid[index])) for index in bases])
        if base == "as_is":
            source.fail(
                f"bench.base=as_is: body {bodies} floats, and nothing holds it in rollouts; set bench.base=fixed"
            )
        source.notes.append(f"floating base: body {bodies} is fixed in its position and orientation from the file")
    if unchosen:
        names = listed([model.joint(index).name or f"number {index}" for index in unchosen])
        if others == "as_is":
            source.fail(
                f"bench.others=as_is: {len(unchosen)} joints are not chosen ({names}); choose them or set it to fixed"
            )
        balls = sum(_KINDS[int(model.jnt_type[index])] == "ball" for index in unchosen)
        which = f", {balls} of them ball joints," if balls else ""
        source.notes.append(
            f"{len(unchosen)} joints are not chosen{which} and stand at their reference position: {names}"
        )
