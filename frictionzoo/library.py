"""Parts of the zoo by name, for programs and notebooks."""

import copy
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import check_overrides, compose_config, list_choices
from frictionzoo.models import FrictionModel, get_model
from frictionzoo.result.identified import Identified


def load(folder: str | Path) -> Identified:
    """A run that has ended, read back from what it left.

    Args:
        folder: Where `result.json` lies.

    Raises:
        RunError: It is not the folder of a finished run of this version, or one of its files is damaged.
        BenchError: The bench's MJCF is not there any more, or not what it was.
    """
    return Identified.load(Path(folder))


def law(name: str, nv: int = 1, **options: Any) -> FrictionModel:
    """A friction law with the initial values, bounds and options that `conf/model` gives it.

    Args:
        name: Of the law: a file of `conf/model`, or a law of this program that was registered.
        nv: Number of joints.
        options: Of the law, in place of the file's: `law("neural_friction", hidden=[8, 8])`, or of parameters,
            `law("coulomb_smooth", params={"static_torque": {"init": 0.2}})`.

    Returns:
        A `torch.nn.Module`: its parameters are in SI units, those of a network its weights.

    Raises:
        UnknownModelError: No such law.
        ConfigError: No such option, or a value that it cannot have.
    """
    if name not in list_choices("model"):
        return get_model(name)(nv, **options)
    plain = compose_config(f"model={name}")
    changed = copy.deepcopy(plain)
    OmegaConf.set_struct(changed, False)
    changed = cast(DictConfig, OmegaConf.merge(changed, {"model": options}))
    check_overrides(changed, plain)
    return build(cast(dict[str, Any], OmegaConf.to_container(changed, resolve=True))["model"], nv=nv)
