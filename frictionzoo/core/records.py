"""Records: typed parts of a JSON file, and the types of their numbers, text and lists."""

import json
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Natural = Annotated[int, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1)]
Samples = Annotated[int, Meta(ge=2)]
Text = Annotated[str, Meta(min_length=1)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Joints = Annotated[list[str], Meta(min_length=1)]
WhereThere = Annotated[list[float | None], Meta(min_length=2)]
Interval = Annotated[list[float], Meta(min_length=2, max_length=2)]
Intervals = Annotated[list[float | Interval | None], Meta(min_length=2)]
"""An interval, or one for each joint; msgspec takes one type of list."""
Carried = Annotated[list[float], Meta(min_length=7, max_length=7)]
Vector = Annotated[list[float], Meta(min_length=3, max_length=3)]
Moments = Annotated[list[float], Meta(min_length=6, max_length=6)]
Number = Literal["float32", "float64"]
Simulator = Literal["mjx", "specialised"]


class Record(msgspec.Struct, forbid_unknown_fields=True):
    """Base class of a part of a JSON file: the Python object, the JSON and its schema.

    The text below a field describes it in the schema. `record["key"]` is `record.key`, as in the file.
    """

    def __getitem__(self, key: str) -> Any:
        """Return the field of this name; KeyError if there is none."""
        if key not in self.__struct_fields__:
            raise KeyError(key)
        return getattr(self, key)


def map_texts(value: Any, change: Callable[[str], str]) -> Any:
    """Return the same records, mappings, lists and tuples with every text changed."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, Record):
        return type(value)(*(map_texts(value[name], change) for name in value.__struct_fields__))
    if isinstance(value, Mapping):
        return {map_texts(key, change): map_texts(part, change) for key, part in value.items()}
    return type(value)(map_texts(part, change) for part in value) if type(value) in (list, tuple) else value


def read_schema(package: str, name: str) -> dict[str, Any]:
    """Return the JSON schema `NAME.schema.json` of a package, which documents every field of a file."""
    return json.loads(resources.files(package).joinpath(f"{name}.schema.json").read_text("utf-8"))


class Proof(Record):
    """Difference between the engine and MuJoCo C."""

    step: NotNegative
    """Largest difference of a position or velocity after one step [rad or m, rad/s or m/s]; relative for values above
    1."""
    rollout: NotNegative
    """The same after all steps."""
    cases: Count
    """Number of rollouts."""
    steps: Count
    """Steps in each rollout."""


class Failure(Record):
    """A job without a result."""

    run: str
    """Name of the job's folder."""
    model: str
    """Name of the friction model; empty: unknown."""
    reason: str
    """Reason for the missing result, in one line."""
