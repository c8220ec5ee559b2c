"""Whether a fit identified the drive at all."""

from collections.abc import Mapping
from typing import Any

BOUNDS = 2  # identified parameters at bounds from which on that is doubted
LITTLE = 1 / 3  # of the test error without friction; a law that identifies a drive leaves less


def explain_failure(result: Mapping[str, Any]) -> list[str] | None:
    """Why a fit did not identify the drive, and the likely reasons, the likeliest first; None where it may have.

    It did not if several parameters ended at a bound and the test error is still more than a third of that without
    friction: then the law makes up for something else with values that no drive has.

    Args:
        result: What `result.json` holds.
    """
    ended = [f"{p['owner']}.{p['name']}" for p in result["parameters"] if p["at_bound"]]
    error, without = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    gained_little = error is None or (without is not None and error > LITTLE * without)
    if len(ended) < BOUNDS or not gained_little:
        return None
    share = "cannot be told" if error is None or not without else f"is {100 * error / without:.0f} % of no friction's"
    return [
        f"{' and '.join(ended)} ended at their bounds, and the test error {share}",
        *result["warnings"],
        "what is taken as known is not so: the actuator's gains, the MJCF's inertia and gravity, the recordings' units",
        "commands act late, which bench.params.delay would find",
        "the recordings do not excite the drive, or the bounds are not those of this drive",
    ]
