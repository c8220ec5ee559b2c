"""Types of numbers, text and lists in a record, with their JSON schema keywords."""

from typing import Annotated, Literal

Positive = Annotated[float, ("exclusiveMinimum", 0)]
NotNegative = Annotated[float, ("minimum", 0)]
Natural = Annotated[int, ("minimum", 0)]
Count = Annotated[int, ("minimum", 1)]
Samples = Annotated[int, ("minimum", 2)]
Text = Annotated[str, ("minLength", 1)]
Sha256 = Annotated[str, ("pattern", "^[0-9a-f]{64}$")]
Joints = Annotated[list[str], ("minItems", 1)]
PerJoint = Annotated[list[float], ("minItems", 2)]
WhereThere = Annotated[list[float | None], ("minItems", 2)]
Interval = Annotated[list[float], ("minItems", 2), ("maxItems", 2)]
Intervals = Annotated[list[Interval | None], ("minItems", 2)]
Carried = Annotated[list[float], ("minItems", 7), ("maxItems", 7)]
Vector = Annotated[list[float], ("minItems", 3), ("maxItems", 3)]
Moments = Annotated[list[float], ("minItems", 6), ("maxItems", 6)]
Number = Literal["float32", "float64"]
Simulator = Literal["mjx", "specialised"]
