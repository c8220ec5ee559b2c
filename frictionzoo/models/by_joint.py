"""Laws of their own for groups of joints."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError, ModelError, closest
from frictionzoo.core.params import fits
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, TorchFriction, Values, register_model

Section = Mapping[str, Any]
"""A law's class, `_target_`, and the arguments of its constructor but for the number of joints."""


@register_model("by_joint")
class ByJoint(FrictionModel):
    """Laws of their own for groups of joints, another for the knee than for the hip, side by side in one drive.

    friction_j = L(j)(q_j, v_j, ...)

        j  the joint
        L  law of the first of the patterns of `laws` that fits the joint's name, or of its entry in the list

    The parameters of a law are of its joints alone, by the law's name and their own: `stribeck.damping`. A law that
    several patterns name has them once for each, `stribeck_1.damping`, `stribeck_2.damping`. A network shares its
    weights among the joints of its pattern, and learns its normalisation from them; another pattern's has others.

    `model.laws={.*_calf_joint: stribeck, .*: mujoco_default}`. A law with options is a section:
    `{.*_calf_joint: {law: stribeck, params: {damping: {init: 0.2}}}, .*: mujoco_default}`. Patterns are regular
    expressions that match whole names; where both come from a file and the command line, those of the file are the
    first. A list has a law for each joint, in their order.

    Cannot represent: friction of a joint that depends on the state of another one; a law that exists only in torch.

    Source: composition of this package; each law has its own.

    Args:
        nv: Number of joints.
        laws: Section of a law for each pattern of joints' names, or a list with one for each joint.

    Raises:
        ConfigError: A list has another length, a law cannot be made, or two of them differ in what they look at.
        ModelError: A law exists only in torch, or is this one.
    """

    def __init__(self, nv: int, laws: Mapping[str, Section] | Sequence[Section]) -> None:
        super().__init__(nv)
        self._sections: dict[str, Section] = {}
        self.labels: tuple[str, ...] = ()
        self.members: tuple[tuple[int, ...], ...] = ()
        self.order: tuple[int, ...] = ()
        self.widths: tuple[int, ...] = ()
        if isinstance(laws, Mapping):
            self._sections = dict(laws)
            if len(laws) == 1:  # no need to know the names
                self._take([*laws.items()], [list(range(nv))])
            return
        if len(laws) != nv:
            raise ConfigError(f"model.laws: {len(laws)} laws, expected {nv}, one a joint; or go by patterns of names")
        first = [list(laws).index(law) for law in laws]
        groups = {at: [joint for joint in range(nv) if first[joint] == at] for at in first}
        self._take([(f"[{at}]", laws[at]) for at in groups], [*groups.values()])

    @property
    def laws(self) -> tuple[FrictionModel, ...]:
        """The law of each group of joints.

        Raises:
            ConfigError: They go by names of joints, which it does not know yet.
        """
        if not self.labels:
            raise ConfigError(
                "model.laws: patterns of joints' names, but it does not know them; call bind(bench.joints)"
            )
        found: Any = tuple(self.get_submodule(label) for label in self.labels)
        return found

    @property
    def constrained(self) -> tuple[bool, ...]:
        """See `FrictionModel`."""
        own = {j: law.constraint for law, joints in zip(self.laws, self.members, strict=True) for j in joints}
        return tuple(own.get(joint, False) for joint in range(self.nv))

    def of_joint(self, joint: int) -> tuple[FrictionModel, int, str]:
        """See `FrictionModel.of_joint`."""
        group = next(number for number, members in enumerate(self.members) if joint in members)
        return self.laws[group], self.members[group].index(joint), f"{self.labels[group]}."

    def bind(self, joints: Sequence[str]) -> None:
        """Give each joint the law of its pattern, and see `FrictionModel.bind`.

        Raises:
            ConfigError: A joint fits no pattern, or a pattern has no joint.
        """
        if self._sections:
            groups = _assign([*self._sections], joints)
            if not self.labels:
                self._take([*self._sections.items()], groups)
        for law, own in zip(self.laws, self.members, strict=True):
            law.bind([joints[joint] for joint in own])
        self._gather()

    def begin(self, values: Mapping[str, Any]) -> None:
        """See `FrictionModel.begin`."""
        for label, joints, law in zip(self.labels, self.members, self.laws, strict=True):
            law.begin({name: np.asarray(value)[list(joints)] for name, value in _own(values, label).items()})

    def prepare(self, samples: DriveState) -> None:
        """Each law takes its constants from the samples of its joints."""
        for joints, law in zip(self.members, self.laws, strict=True):
            law.prepare(_seen(samples, joints, len(self.members)))

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The terms of each joint's law; 0 where it does not use one that another does."""
        parts = [
            law.terms(xp, _own(values, label), _seen(state, joints, len(self.members)))
            for label, joints, law in zip(self.labels, self.members, self.laws, strict=True)
        ]
        return _join_terms(xp, parts, self.members, self.order, state)

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The memory of each joint's law, filled up with 0 to that of the law that remembers most."""
        parts = []
        for label, joints, width, law in zip(self.labels, self.members, self.widths, self.laws, strict=True):
            seen = _seen(state, joints, len(self.members))
            held = law.settle(xp, _own(values, label), seen)
            parts.append(_fill(xp, held, self.memory - width, seen))
        return _join(xp, parts, self.order, -2)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """A step of each joint's law."""
        parts, after = [], []
        for label, joints, width, law in zip(self.labels, self.members, self.widths, self.laws, strict=True):
            seen, held = _seen(state, joints, len(self.members)), memory[..., np.array(joints), :width]
            terms, held = law.advance(xp, _own(values, label), seen, held, timestep)
            parts.append(terms)
            after.append(_fill(xp, held, self.memory - width, seen))
        return _join_terms(xp, parts, self.members, self.order, state), _join(xp, after, self.order, -2)

    def _take(self, laws: Sequence[tuple[str, Section]], groups: Sequence[Sequence[int]]) -> None:
        """Make the law of each group of joints."""
        made = [_make(option, section, len(joints)) for (option, section), joints in zip(laws, groups, strict=True)]
        self.labels = _label([law.name for law in made])
        self.members = tuple(map(tuple, groups))
        self.order = tuple(np.argsort(np.concatenate(groups)).tolist())
        for label, law in zip(self.labels, made, strict=True):
            if hasattr(self, label):
                raise ModelError(f"model.laws: {label}: no name for one law of several; register it by another one")
            self.add_module(label, law)
        self.constraint = any(law.constraint for law in made)
        self.dissipative = all(law.dissipative for law in made)
        self.widths = tuple(law.memory for law in made)
        self.memory = max(self.widths)
        self.shortest_segment = max(law.shortest_segment for law in made)
        self.inputs = _merge_inputs(made)
        self._gather()

    def _gather(self) -> None:
        """The parameters of all laws, each of the joints of its law."""
        self.params = {
            f"{label}.{name}": replace(param, joints=joints if len(joints) < self.nv else None)
            for label, joints, law in zip(self.labels, self.members, self.laws, strict=True)
            for name, param in law.params.items()
        }


def _make(option: str, section: Section, nv: int) -> FrictionModel:
    if not isinstance(section, Mapping) or "_target_" not in section:
        raise ConfigError(
            f"model.laws: {option}: {section!r}, expected a law's section; frictionzoo.law('by_joint', laws=...) knows "
            "laws by name"
        )
    try:
        law = build({key: value for key, value in section.items() if key != "nv"}, nv=nv)
    except ConfigError as error:
        raise ConfigError(f"model.laws: {option}: {error}") from error
    if not isinstance(law, FrictionModel):
        raise ConfigError(f"model.laws: {option}: {section['_target_']}, expected a friction law")
    if isinstance(law, TorchFriction | ByJoint):
        why = "exists only in torch" if isinstance(law, TorchFriction) else "has laws of its own"
        raise ModelError(f"model.laws: {option}: {law.name} {why}, expected a formula for some of the joints")
    return law


def _assign(patterns: Sequence[str], joints: Sequence[str]) -> list[list[int]]:
    """Joints of each pattern, the first that fits; ConfigError where a joint has none, or a pattern no joint."""
    groups: dict[str, list[int]] = {pattern: [] for pattern in patterns}
    for index, joint in enumerate(joints):
        fitting = [pattern for pattern in patterns if fits(pattern, joint, "model.laws")]
        if not fitting:
            raise ConfigError(
                f"model.laws: no pattern of {', '.join(patterns)} fits {joint}; add one, such as '.*', last"
            )
        groups[fitting[0]].append(index)
    for pattern, own in groups.items():
        if not own:
            taken = [joint for joint in joints if fits(pattern, joint, "model.laws")]
            why = f"{taken[0]} has the law of a pattern before it; put it first" if taken else closest(pattern, joints)
            raise ConfigError(f"model.laws: {pattern}: no joint for it; {why}, or leave it out")
    return [*groups.values()]


def _label(names: Sequence[str]) -> tuple[str, ...]:
    """Each law's name, numbered from 1 where several have it."""
    count, seen, labels = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        labels.append(name if count[name] == 1 else f"{name}_{seen[name]}")
    return tuple(labels)


def _merge_inputs(laws: Sequence[FrictionModel]) -> dict[str, float]:
    """What the laws look at; they have to agree on what it is where recordings lack it."""
    inputs: dict[str, float] = {}
    for law in laws:
        for name, value in law.inputs.items():
            if inputs.setdefault(name, value) != value:
                raise ConfigError(
                    f"model.laws: {name} is {inputs[name]:g} to one law and {value:g} to {law.name} where recordings "
                    "lack it, expected one number; give both the same reference"
                )
    return inputs


def _own(values: Values, label: str) -> dict[str, Any]:
    """Values of one law, by the names that it has for them."""
    return {name[len(label) + 1 :]: value for name, value in values.items() if name.startswith(label + ".")}


def _seen(state: DriveState, joints: Sequence[int], groups: int) -> DriveState:
    """The state of these joints alone, one of so many groups."""
    if groups == 1:
        return state
    return type(state)(*(None if signal is None else signal[..., np.array(joints)] for signal in state))


def _join_terms(
    xp: Any, parts: Sequence[FrictionTerms], members: Sequence[Sequence[int]], order: Sequence[int], state: DriveState
) -> FrictionTerms:
    """Terms of all joints from those of each group; a term that no law uses is left out."""
    if len(parts) == 1:
        return parts[0]
    found = []
    for given in zip(*parts, strict=True):
        if all(term is None for term in given):
            found.append(None)
            continue
        zeros = [xp.zeros_like(state.qvel[..., np.array(joints)]) for joints in members]
        whole = [none if term is None else term + none for term, none in zip(given, zeros, strict=True)]
        found.append(_join(xp, whole, order, -1))
    return FrictionTerms(*found)


def _join(xp: Any, parts: Sequence[Any], order: Sequence[int], axis: int) -> Any:
    """Arrays of all groups as one of all joints, in their order."""
    if len(parts) == 1:
        return parts[0]
    whole = xp.concatenate(parts, axis)
    return whole[..., np.array(order)] if axis == -1 else whole[..., np.array(order), :]


def _fill(xp: Any, memory: Any, missing: int, seen: DriveState) -> Any:
    """A law's memory with so many zeros behind it."""
    return memory if not missing else xp.concatenate([memory, xp.stack(missing * [xp.zeros_like(seen.qvel)], -1)], -1)
