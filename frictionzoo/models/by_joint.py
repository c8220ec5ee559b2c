"""Different friction models for groups of joints."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError, ModelError, closest
from frictionzoo.core.params import fits
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, TorchFriction, Values, register_model

Section = Mapping[str, Any]
"""Class of a model, `_target_`, and the arguments of its constructor except the number of joints."""


@register_model("by_joint")
class ByJoint(FrictionModel):
    """Different friction models for groups of joints of one robot, such as knee and hip.

    Use it if the joints of a robot have different drives: `model.laws={.*_calf_joint: stribeck, .*: mujoco_default}`.

    Cannot represent: friction of a joint that depends on the state of another joint; a model that exists only in torch.

    friction_j = L(j)(q_j, v_j, ...)

        j  the joint
        L  model of the first pattern in `laws` that matches the joint's name, or of the joint's entry in the list

    A model with options is a section:
    `{.*_calf_joint: {law: stribeck, params: {damping: {init: 0.2}}}, .*: mujoco_default}`. Patterns are regular
    expressions that match whole names. If patterns come from a file and from the command line, the file's come first. A
    list has one model per joint, in their order.

    Each model has parameters for its joints only, named after the model: `stribeck.damping`. If several patterns name
    the same model, each has its parameters: `stribeck_1.damping`, `stribeck_2.damping`. A network shares its weights
    among the joints of its pattern, and takes its normalisation from them; another pattern has a separate network.

    Source: composition of this package; each model has its source.

    Args:
        nv: Number of joints.
        laws: Section of a model for each pattern of joint names, or a list with one for each joint.

    Raises:
        ConfigError: A list has the wrong length, a model cannot be made, or two models differ in an input's default.
        ModelError: A model exists only in torch, or is `by_joint`.
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
            if len(laws) == 1:  # needs no joint names
                self._take([*laws.items()], [list(range(nv))])
            return
        if len(laws) != nv:
            raise ConfigError(f"model.laws: {len(laws)} laws, expected {nv}, one a joint; or go by patterns of names")
        first_index = [list(laws).index(law) for law in laws]
        groups = {index: [joint for joint in range(nv) if first_index[joint] == index] for index in first_index}
        self._take([(f"[{index}]", laws[index]) for index in groups], [*groups.values()])

    @property
    def laws(self) -> tuple[FrictionModel, ...]:
        """Model of each group of joints.

        Raises:
            ConfigError: The models are given by patterns, and the joint names are not known yet.
        """
        if not self.labels:
            raise ConfigError("model.laws: patterns of joint names, but the names are unknown; call bind(bench.joints)")
        models: Any = tuple(self.get_submodule(label) for label in self.labels)
        return models

    @property
    def constrained(self) -> tuple[bool, ...]:
        """See `FrictionModel`."""
        by_joint = {j: law.constraint for law, joints in zip(self.laws, self.members, strict=True) for j in joints}
        return tuple(by_joint.get(joint, False) for joint in range(self.nv))

    def of_joint(self, joint: int) -> tuple[FrictionModel, int, str]:
        """See `FrictionModel.of_joint`."""
        group = next(number for number, members in enumerate(self.members) if joint in members)
        return self.laws[group], self.members[group].index(joint), f"{self.labels[group]}."

    def bind(self, joints: Sequence[str]) -> None:
        """Assign a model to each joint by its pattern; see `FrictionModel.bind`.

        Raises:
            ConfigError: A joint matches no pattern, or a pattern has no joint.
        """
        if self._sections:
            groups = _assign([*self._sections], joints)
            if not self.labels:
                self._take([*self._sections.items()], groups)
        for law, members in zip(self.laws, self.members, strict=True):
            law.bind([joints[joint] for joint in members])
        self._gather()

    def begin(self, values: Mapping[str, Any]) -> None:
        """See `FrictionModel.begin`."""
        for label, joints, law in zip(self.labels, self.members, self.laws, strict=True):
            law.begin({name: np.asarray(value)[list(joints)] for name, value in _own(values, label).items()})

    def prepare(self, samples: DriveState) -> None:
        """Let each model take its constants from the samples of its joints."""
        for law, _, part in self._groups({}, samples):
            law.prepare(part)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the terms of each joint's model; 0 for a term that only other joints' models use."""
        parts = [law.terms(xp, own, part) for law, own, part in self._groups(values, state)]
        return _join_terms(xp, parts, self.members, self.order, state)

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the memory of each joint's model, padded with 0 to the largest memory."""
        parts = [
            _fill(xp, law.settle(xp, own, part), self.memory, part) for law, own, part in self._groups(values, state)
        ]
        return _join(xp, parts, self.order, -2)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Advance each joint's model by one step."""
        return self._advance("advance", xp, values, state, memory, timestep)

    def advance_midway(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """See `FrictionModel.advance_midway`."""
        return self._advance("advance_midway", xp, values, state, memory, timestep)

    def _advance(
        self, method: str, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        parts, after = [], []
        groups = zip(self._groups(values, state), self.members, self.widths, strict=True)
        for (law, own, part), joints, width in groups:
            step = getattr(law, method)
            terms, law_memory = step(xp, own, part, memory[..., np.array(joints), :width], timestep)
            parts.append(terms)
            after.append(_fill(xp, law_memory, self.memory, part))
        return _join_terms(xp, parts, self.members, self.order, state), _join(xp, after, self.order, -2)

    def _groups(self, values: Values, state: DriveState) -> Iterator[tuple[FrictionModel, dict[str, Any], DriveState]]:
        """Yield the model of each group of joints, with its values and the state of its joints."""
        for label, joints, law in zip(self.labels, self.members, self.laws, strict=True):
            yield law, _own(values, label), _seen(state, joints, len(self.members))

    def _take(self, laws: Sequence[tuple[str, Section]], groups: Sequence[Sequence[int]]) -> None:
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
        self.export_target = "mjcf" if all(law.export_target == "mjcf" for law in made) else "mujoco"
        self.widths = tuple(law.memory for law in made)
        self.memory = max(self.widths)
        self.shortest_segment = max(law.shortest_segment for law in made)
        self.inputs = _merge_inputs(made)
        self._gather()

    def _gather(self) -> None:
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
    """Return the joints of each pattern, first match; ConfigError if a joint or a pattern has no match."""
    groups: dict[str, list[int]] = {pattern: [] for pattern in patterns}
    for index, joint in enumerate(joints):
        fitting = [pattern for pattern in patterns if fits(pattern, joint, "model.laws")]
        if not fitting:
            raise ConfigError(
                f"model.laws: no pattern of {', '.join(patterns)} fits {joint}; add one, such as '.*', last"
            )
        groups[fitting[0]].append(index)
    for pattern, members in groups.items():
        if not members:
            taken = [joint for joint in joints if fits(pattern, joint, "model.laws")]
            why = f"{taken[0]} matches an earlier pattern; put this one first" if taken else closest(pattern, joints)
            raise ConfigError(f"model.laws: {pattern}: no joint for it; {why}, or leave it out")
    return [*groups.values()]


def _label(names: Sequence[str]) -> tuple[str, ...]:
    """Return each model's name, numbered from 1 if several models have the same name."""
    count, used, labels = Counter(names), Counter[str](), []
    for name in names:
        used[name] += 1
        labels.append(name if count[name] == 1 else f"{name}_{used[name]}")
    return tuple(labels)


def _merge_inputs(laws: Sequence[FrictionModel]) -> dict[str, float]:
    """Return the inputs of all models; their defaults for recordings without the signal must agree."""
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
    """Return one model's values under that model's names."""
    return {name[len(label) + 1 :]: value for name, value in values.items() if name.startswith(label + ".")}


def _seen(state: DriveState, joints: Sequence[int], groups: int) -> DriveState:
    """Return the state of these joints, one of `groups` groups."""
    if groups == 1:
        return state
    return type(state)(*(None if signal is None else signal[..., np.array(joints)] for signal in state))


def _join_terms(
    xp: Any, parts: Sequence[FrictionTerms], members: Sequence[Sequence[int]], order: Sequence[int], state: DriveState
) -> FrictionTerms:
    """Join the terms of all groups; a term that no model uses stays None."""
    if len(parts) == 1:
        return parts[0]
    joined = []
    for group_terms in zip(*parts, strict=True):
        if all(term is None for term in group_terms):
            joined.append(None)
            continue
        zeros = [xp.zeros_like(state.qvel[..., np.array(joints)]) for joints in members]
        filled = [zero if term is None else term + zero for term, zero in zip(group_terms, zeros, strict=True)]
        joined.append(_join(xp, filled, order, -1))
    return FrictionTerms(*joined)


def _join(xp: Any, parts: Sequence[Any], order: Sequence[int], axis: int) -> Any:
    """Join the groups' arrays into one of all joints, in their order."""
    if len(parts) == 1:
        return parts[0]
    joined = xp.concatenate(parts, axis)
    return joined[..., np.array(order)] if axis == -1 else joined[..., np.array(order), :]


def _fill(xp: Any, memory: Any, width: int, seen: DriveState) -> Any:
    """Return a memory with zeros appended up to this width."""
    missing = width - memory.shape[-1]
    return memory if not missing else xp.concatenate([memory, xp.stack(missing * [xp.zeros_like(seen.qvel)], -1)], -1)
