"""Jobs that a page shows, composed."""

import itertools

from conftest import compose_once
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from frictionzoo.core.config import CONF_DIR, check_overrides, list_choices
from helpers.pages import expand

FLAGS = {"-m", "--cfg", "job", "--help"}


def is_choice(override):
    """Whether it chooses a file, or tells Hydra itself something: that has to be composed."""
    name = override.partition("=")[0]
    return name.startswith("hydra") or (CONF_DIR / name).is_dir()


def assert_composes(job):
    """Every job that these arguments of a run stand for."""
    choices = [expand(argument) for argument in job if argument not in FLAGS]
    for values in filter(lambda values: is_choice(values[0]) and len(values) > 1, choices):
        assert all(name in list_choices(group) for group, name in (value.split("=") for value in values))
        del values[1:]  # tests/test_config.py composes every file, and experiments with the laws that change them
    for index in range(max(map(len, choices), default=1)):
        overrides = [values[index % len(values)] for values in choices]
        plain = compose_once(*filter(is_choice, overrides))
        config = OmegaConf.create(OmegaConf.to_container(plain))
        for override in map(OverridesParser.create().parse_override, itertools.filterfalse(is_choice, overrides)):
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=True)
        check_overrides(config, plain)
