"""What tests share: the composed configuration, parts built from it, and where real recordings lie."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.config import build, compose_config

DATA = os.environ.get("FRICTIONZOO_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="FRICTIONZOO_DATA is not set; it names the folder of recordings")


@pytest.fixture(scope="session")
def compose() -> Callable[..., DictConfig]:
    """Composes a job's configuration from overrides, as the command line would."""
    return compose_config


@pytest.fixture(scope="session")
def make() -> Callable[..., Any]:
    """Builds the part `section` of the configuration with these overrides; more arguments go to the constructor."""

    def make(section: str, *overrides: str, **more: Any) -> Any:
        config = OmegaConf.to_container(compose_config(*overrides), resolve=True)
        return build(config[section], **more)

    return make


@pytest.fixture(scope="session")
def knee(make: Callable[..., Any]) -> Bench:
    """The paper's bench."""
    return make("bench")


@pytest.fixture(scope="session")
def compilation_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the programs that tests start share compiled functions."""
    return tmp_path_factory.mktemp("xla")
