"""Outcome of one check, as pages and `inspect.json` list it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """Outcome of one check of a result or of data.

    Attributes:
        state: `good`, `note`, `caution` or `bad`.
        text: Outcome in plain sentences.
        option: Option to add to the command line; None for none.
    """

    state: str
    title: str
    text: str
    option: str | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the check found a problem."""
        return self.state in ("caution", "bad")
