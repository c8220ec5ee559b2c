"""Absurd values of options: one line that names the option, or a run that means it; never a traceback."""

import functools
import operator
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from omegaconf import DictConfig, OmegaConf

from frictionzoo.cli import job
from frictionzoo.cli.explain import explain
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.cli.resume import restore_overrides
from frictionzoo.core.build import build
from frictionzoo.core.config import CONF_DIR, check_overrides, compose_config, list_options, read_value
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.state import DriveState
from frictionzoo.export.write import read_number
from frictionzoo.fit import loggers, loop
from frictionzoo.identification import problem
from frictionzoo.simulation.proof import Proof

VALUES = (float("nan"), float("inf"), None, "", 0, -1, 1e9, "absurd", [])
NAMED = VALUES[:4]  # what never is the matter of another option

compose_once = functools.cache(compose_config)  # what it returns is not to be changed


def change(config: DictConfig, key: str, value: Any) -> DictConfig:
    """A configuration with another value, which need not fit."""
    changed = OmegaConf.create(OmegaConf.to_container(config))
    OmegaConf.update(changed, key, value, merge=True)
    return changed


def refuse(config: DictConfig, key: str, value: Any, *sections: str) -> str:
    """The line with which a value is refused, where options are checked or where these sections are built."""
    changed = change(config, key, value)
    with pytest.raises(FrictionzooError) as refused:
        check_overrides(changed, config)
        settings = OmegaConf.to_container(changed, resolve=True)
        for section in sections:
            build(settings[section], **({"nv": 1} if section == "model" else {}))
    return str(refused.value)


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("segments.count", np.nan, "segments.count=nan; expected a whole number such as 20000, or null"),
        ("loss.position", np.nan, "loss.position=nan; expected a finite number"),
        ("evaluation.horizons", [np.inf], "evaluation.horizons=[inf]; expected a finite number"),
        ("loss.velocity", None, "loss.velocity=null; expected a number such as 1.0"),
        ("loss.velocity", 10**20, f"loss.velocity={10**20}; expected whole numbers of at most {2**63 - 1}"),
        ("fit.iterations", 2**31, f"fit.iterations={2**31}; expected whole numbers of at most {2**31 - 1}"),
        ("seed", 2**63, f"seed={2**63}; expected whole numbers of at most {2**63 - 1}"),
        ("compilation_cache", "", "compilation_cache=; expected text such as user, or null"),
        ("data.cache_dir", "", "data.cache_dir=; expected text such as user, or null"),
        ("bench.timestep", "fast", "bench.timestep=fast; expected a number, or null"),
        ("bench.params.delay.scale", None, "bench.params.delay.scale=null; expected text or a number such as 0.01"),
        ("bench.params.delay.high", np.inf, "bench.params.delay.high=inf; expected a finite number"),
        ("scale.torque", None, "scale.torque=null; expected a number such as 1.0"),
        ("scale.torque", 0, "scale.torque=0; expected a number above 0 such as 1.0"),
        ("scale", None, "scale=null; expected a section with torque"),
    ],
)
def test_a_value_of_another_kind_is_refused_by_its_name(key: str, value: Any, line: str) -> None:
    assert refuse(compose_once(), key, value).startswith(line)


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("data.train", 3, "data.train=3; expected text or a list"),
        ("data.columns.qpos", 3, "data.columns.qpos=3; expected text or a list, or null"),
        ("data.columns", None, "data.columns=null; expected a section with time"),
        ("data.where", {"kp": [np.nan]}, "data.where.kp=[nan]; expected a finite number"),
        ("data.sign.qpos", 0, "data.sign.qpos=0: expected 1 or -1"),
        ("data.units.supply", "mile", "data.units.supply=mile: unknown unit; expected one of V, mV"),
        ("data.units.qpos", 0, "data.units.qpos=0: unknown unit"),
        ("data.format", "absurd", "data.format=absurd: no such format; expected one of auto, bam"),
        ("data.clean.wrap", "", "data.clean.wrap=; expected a number, or null"),
        ("data.clean.order", 10**9, "data.clean.order=1e+09: expected 1 to 20"),
        ("bench.solreffriction", [0.02], "bench.solreffriction=[0.02]; expected two numbers above 0"),
        ("bench.solreffriction", [0.02, 1.0, 1.0], "bench.solreffriction=[0.02, 1.0, 1.0]; expected two numbers"),
    ],
)
def test_an_option_of_files_and_the_bench_is_refused_by_its_name(key: str, value: Any, line: str) -> None:
    assert refuse(compose_once("data=files", "bench=knee", "recipe=given"), key, value, "bench", "data").startswith(
        line
    )


@pytest.mark.parametrize(
    ("choice", "key", "value", "line"),
    [
        ("data=twin", "data.samples", 10**9, "data.samples=1000000000 with data.substeps=4: 4e+09 simulation steps"),
        ("data=twin", "data.excitation.harmonics", 0, "data.excitation.harmonics=0: expected 1 to 1000"),
        ("data=twin", "data.excitation.phase", [1.0], "data.excitation.phase=[1.0]: expected two numbers"),
        ("data=twin", "data.sensor.velocity_noise", -1, "data.sensor.velocity_noise=-1: expected 0 or more"),
        ("data=emps", "data.train", ["a.mat"], "data.train=['a.mat']: expected the name of one file"),
        ("data=emps", "data.order", 0, "data.order=0: expected 1 to 20"),
        ("fit=lm", "fit.iterations", 10**9, "fit.iterations=1e+09: expected 1 to 10000"),
        ("fit=auto", "fit.tries", 10**9, "fit.tries=1e+09: expected 1 to 10000"),
        ("model=neural_friction", "model.hidden", [10**9], "model.hidden=[1000000000]; expected widths of at least 1"),
        ("model=neural_friction", "model.hidden", [1.5], "model.hidden=[1.5]; expected a list such as [64, 64]"),
        ("model=history_network", "model.memory", 10**9, "model.memory=1e+09: expected 1 to 4096"),
        ("model=history_network", "model.time_constants", [0.1], "model.time_constants=[0.1]; expected two above 0 s"),
        ("model=maxwell_slip", "model.elements", 10**9, "model.elements=1e+09: expected 1 to 1000"),
    ],
)
def test_a_size_that_no_memory_holds_is_refused_by_its_name(choice: str, key: str, value: Any, line: str) -> None:
    assert refuse(compose_once(choice), key, value, choice.partition("=")[0]).startswith(line)


@pytest.fixture
def posing(call: Callable, monkeypatch: pytest.MonkeyPatch) -> type[Exception]:
    """What a job raises once its problem is posed, before anything is compiled; `call` undoes what that does to JAX."""

    class PosedError(Exception):
        pass

    def begin(fit: Any, objective: Any, *_: Any) -> None:
        fit.total(objective)
        fit.init(objective)
        raise PosedError

    def seen(drive: Any, bench: Any, dataset: Any) -> DriveState:
        signal = np.concatenate([log.qpos for log in dataset.train])
        return DriveState(*[signal] * len(DriveState._fields))

    monkeypatch.setattr(problem, "prove", lambda *_: Proof(0.0, 0.0, 1, 1))
    monkeypatch.setattr(problem, "_training_samples", seen)
    monkeypatch.setattr(loop, "FitModule", begin)
    return PosedError


@pytest.fixture
def judge(posing: type[Exception], tmp_path: Path) -> Callable[..., str | None]:
    """Poses a problem with another value of an option: the line that refuses it, None for a run that begins."""

    def judge(config: DictConfig, plain: DictConfig, key: str, value: Any) -> str | None:
        before = functools.reduce(operator.getitem, key.split("."), OmegaConf.to_container(config))
        try:
            OmegaConf.update(config, key, value)
            check_overrides(config, plain)
            job.run_job(config, "model", tmp_path / "run")
        except posing:
            return None
        except TypeCheckError:  # tests check types at run time, and these tell a whole number from a float
            assert type(value) is int
            return judge(config, plain, key, float(value))
        except Exception as error:
            line = explain(error)
            if line is None:
                raise AssertionError(f"{key}={value}") from error
            assert line and "\n" not in line
            return line
        finally:
            OmegaConf.update(config, key, before)
        raise AssertionError("it went on")

    return judge


@pytest.mark.parametrize(
    ("key", "value", "fragment"),
    [
        ("data.clean.shortest", 1e9, "expected 1e+09 s (data.clean.shortest)"),
        ("data.clean.step", 1e9, "shorter than data.clean.step=1e+09 s"),
        ("data.clean.step", 1e-9, "data.clean.step=1e-09: expected at least 1e-06 s"),
        ("evaluation.local", 1e9, "smaller evaluation.local"),
        ("evaluation.trajectory", 1e9, "smaller evaluation.trajectory"),
        ("evaluation.places", 0, "evaluation.places=0: expected 1 or more"),
        ("bench.timestep", 1e-9, "set a longer bench.timestep"),
        ("bench.params.delay", {"high": 1e9, "identify": True}, "bench.params.delay: up to 1e+09 s"),
        ("loop.chunk", 10**9, "loop.chunk=1e+09: expected 1 to 1e+06"),
        ("fit.iterations", 10**9, None),
        ("segments.count", 10**9, None),
    ],
)
def test_a_problem_of_an_absurd_size_is_refused_by_its_option(
    judge: Callable, tiny: tuple[str, ...], key: str, value: Any, fragment: str | None
) -> None:
    line = judge(compose_config(*tiny), compose_once("data=files", "bench=knee", "recipe=given"), key, value)
    assert line is None if fragment is None else fragment in str(line)


def test_a_grid_of_too_many_combinations_is_refused(judge: Callable, tiny: tuple[str, ...]) -> None:
    grid = ("fit=grid", "model=mujoco_default")
    line = judge(
        compose_config(*tiny, *grid),
        compose_once("data=files", "bench=knee", "recipe=given", *grid),
        "fit.points",
        10**9,
    )
    assert "fit.points=1000000000: 1e+27 combinations of 3 parameters" in str(line)


@pytest.mark.parametrize(
    "value", ["nan", "0", "1e9", "null", "true", "[]", "[a,b]", "{}", "baseline,null", "range(1,3)"]
)
def test_a_choice_of_a_group_that_is_no_name_is_refused(value: str) -> None:
    for group in ("model", "experiment", "variant", "hydra/launcher"):
        with pytest.raises(ConfigError, match=f"^{group}=") as refused:
            refuse_no_choice(["seed=1", f"{group}={value}"])
        assert "expected one of " in str(refused.value)
    refuse_no_choice(["-m", "model=baseline,lugre", "model=glob(*)", "experiment=emps,zoo", "hydra/launcher=joblib"])


@pytest.mark.parametrize("argument", ["data.train=[", "data.where={kp", "=3", "model=choice()"])
def test_an_argument_that_cannot_be_read_is_named(argument: str) -> None:
    with pytest.raises(ConfigError) as refused:
        refuse_no_choice([argument])
    assert str(refused.value).startswith(f"{argument}: ") and "expected KEY=VALUE" in str(refused.value)


@pytest.mark.parametrize("argument", ["hydra.run.dir=", "hydra.sweep.dir=''", "hydra.sweep.subdir=null"])
def test_no_folder_to_write_into_is_refused(argument: str) -> None:
    with pytest.raises(ConfigError) as refused:
        refuse_no_choice([argument])
    assert str(refused.value) == f"{argument}: expected a folder; name one, or leave it out"


def test_no_logger_to_be_verbose_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^hydra\.verbose=nan: expected true, false, or names of loggers"):
        refuse_no_choice(["hydra.verbose=nan"])
    refuse_no_choice(["hydra.verbose=true", "hydra.verbose=[frictionzoo]", "hydra.run.dir=run"])


@pytest.mark.parametrize("values", ["range(1,1000000000)", "range(3,1)", "range(0,1,1e-9)", "range(1,9,0)"])
def test_a_range_without_an_end_is_refused(values: str) -> None:
    with pytest.raises(ConfigError) as refused:
        refuse_no_choice(["-m", f"seed={values}"])
    assert str(refused.value).startswith(f"seed={values}: ") and "expected 1 to 100000; " in str(refused.value)
    refuse_no_choice(["-m", "seed=range(5)", "fit.learning_rate=range(0.1,0.5,0.1)", "seed=range(5,1,-1)"])


def test_no_folder_to_resume_from_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^resume=: expected the folder of a run"):
        restore_overrides(["resume="])


def test_an_option_that_a_model_of_a_sweep_lacks_is_refused(call: Callable, tmp_path: Path) -> None:
    finished = call("-m", "model=neural_friction,coulomb_smooth", "model.hidden=[4]", "hydra.sweep.dir=sweep")
    assert finished.status == 2 and finished.out == "" and finished.err.count("\n") == 1
    assert "model.hidden: unknown option with model=coulomb_smooth; " in finished.err
    assert not (tmp_path / "sweep").exists()


def test_an_option_that_the_default_model_alone_lacks_is_told_how_to_set(call: Callable) -> None:
    finished = call("-m", "model=neural_friction,odd_network", "model.hidden=[4]")
    assert finished.status == 2 and finished.err.count("\n") == 1
    assert "the default model does not; write ++model.hidden=VALUE" in finished.err


def test_a_model_of_a_sweep_that_does_not_exist_is_refused(call: Callable) -> None:
    finished = call("-m", "model=a,b", "model.hidden=[4]")
    assert finished.status == 2 and finished.err.startswith("frictionzoo: model=a: no such model; ")
    assert finished.err.count("\n") == 1


def test_a_section_that_is_no_section_is_refused(call: Callable) -> None:
    finished = call("model.params=[1]")
    assert finished.status == 2 and finished.err.count("\n") == 1
    assert finished.err.startswith("frictionzoo: model.params=[1]: expected a value or a section")


def test_a_step_of_an_export_that_is_no_number_is_refused() -> None:
    for text in ("nan", "inf", "fast", "[1]"):
        with pytest.raises(ConfigError, match=r"^timestep=.*; expected a number"):
            read_number({"timestep": text}, "timestep")


def test_a_value_that_a_distillation_cannot_read_is_refused() -> None:
    for option in ("seed=[", "fit.tries='", "loop={chunk"):
        with pytest.raises(ConfigError, match=r"cannot be read, expected KEY=VALUE") as refused:
            read_value(option)
        assert str(refused.value).startswith(f"{option}: ")


ALIKE = ("delay", "static_torque")  # parameters that stand for all
LAWS = [  # those with other options than parameters
    path.stem
    for path in sorted((CONF_DIR / "model").glob("*.yaml"))
    if {*OmegaConf.load(path)} - {"defaults", "_target_", "params", "model", "bench"}
]
SIMULATED = ("data.samples=800", "data.substeps=2", "data.split.gap=0.05", "data.split.test_share=0.3")
PROBLEMS = [  # what is chosen, and what the keys begin with whose turn it is
    (("data=files",), ""),
    (("data=twin", *SIMULATED), "data."),
    (("data=two_inertia", *SIMULATED), "data.drive."),
    *[((f"fit={name}",), "fit.") for name in ("auto", "grid", "lm", "known")],
    *[((f"logger={name}",), "logger.") for name in ("csv", "wandb", "mlflow")],
    *[((f"model={name}",), "model.") for name in LAWS],
]


def absurd_values(prefix: str, config: DictConfig) -> Iterator[tuple[str, Any]]:
    """Every option whose turn it is with every absurd value; of parameters, some that stand for all."""
    for key, value in list_options(OmegaConf.to_container(config, resolve=True)):
        param = key.partition(".params.")[2].partition(".")[0]
        if key.startswith(prefix) and param in ("", *([] if prefix else ALIKE)):
            longer = [[*value, *(value or ["absurd"])]] if isinstance(value, list) else []
            whole = [] if isinstance(value, float | str) else [10**9]
            for absurd in (*VALUES, *longer, *whole):
                yield key, float(absurd) if isinstance(value, float) and type(absurd) is int else absurd


@pytest.mark.slow
@pytest.mark.parametrize(("choices", "prefix"), PROBLEMS, ids=[choices[0] for choices, _ in PROBLEMS])
def test_no_value_of_any_option_is_a_traceback(
    judge: Callable, tiny: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, choices: tuple[str, ...], prefix: str
) -> None:
    monkeypatch.setattr(loggers, "_require", lambda *packages: None)  # loggers whose package is not installed
    simulated = choices[0].startswith("data=t")
    small = [option for option in tiny if not (simulated and option.startswith("data"))]
    config, plain = (
        compose_config(*small, *choices),
        compose_once("data=files", "bench=knee", "recipe=given", choices[0]),
    )
    for key, value in absurd_values(prefix, config):
        line = judge(config, plain, key, value)
        # A number may be refused by what it leads to; what is none, only as itself.
        assert line is None or key in line or value not in NAMED, (key, value, line)
