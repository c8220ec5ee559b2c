"""`Logs` that `read` returns, with a plot."""

import contextlib
from collections.abc import Iterable

from matplotlib.figure import Figure

from frictionzoo.bench.base import Bench
from frictionzoo.bench.signals import pair_log, refuse_columns
from frictionzoo.core.errors import LogError, refuse_outside
from frictionzoo.core.log import Log
from frictionzoo.core.units import UNITS
from frictionzoo.data import logs
from frictionzoo.data.pairing import label


class Logs(logs.Logs):
    """Recordings with their cleaned logs; iteration yields the logs, and `plot` draws one."""

    @classmethod
    def of(cls, logs: logs.Logs | Log | Iterable[Log]) -> "Logs":
        """See `frictionzoo.data.logs.Logs.of`."""
        return cls(**vars(super().of(logs)))

    def plot(self, number: int = 0, bench: Bench | None = None) -> Figure:
        """Plot position, velocity and command of each joint over time in one log.

        Args:
            number: Number of the log, from 0.
            bench: Its test stand, which gives the names and units of the joints; None: not known.

        Raises:
            ConfigError: There is no such log.
            LogError: The headers do not match the joints of the bench.
            BenchError: The numbers of columns and joints differ.
        """
        # Imported late: plotting libraries slow down other uses.
        from frictionzoo.report.log_plot import draw_log

        refuse_outside("number", number, 0, len(self) - 1)
        log = [*self][number]
        if bench is not None:
            log = pair_log(log, bench.joints, bench.passive)
            refuse_columns(log, bench.joints, bench.source)
            return draw_log(log, bench.joints, [UNITS[bench.joint_type][name] for name in ("position", "velocity")])
        origin = log.columns.get("qpos")
        joints = label(origin.headers if origin else [""] * log.qpos.shape[1])
        with contextlib.suppress(LogError):  # columns with other names keep their order
            log = pair_log(log, joints)
        return draw_log(log, joints, ("rad or m", "rad/s or m/s"))
