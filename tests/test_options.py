"""Absurd values of options: one line that names the option, or a run that means it; never a traceback."""

import functools
import operator
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import check_each, compose_once
from hydra.core.override_parser.overrides_parser import OverridesParser
from jaxtyping import TypeCheckError
from omegaconf import DictConfig, OmegaConf

from frictionzoo.bench.given import Given
from frictionzoo.cli import job
from frictionzoo.cli.explain import explain
from frictionzoo.cli.overrides import refuse_no_choice
from frictionzoo.cli.resume import restore_overrides
from frictionzoo.core.build import build
from frictionzoo.core.config import check_overrides, compose_config, list_options, read_value
from frictionzoo.core.declared import section_of
from frictionzoo.core.errors import ConfigError, FrictionzooError, read_number
from frictionzoo.core.state import DriveState
from frictionzoo.fit import loggers, loop
from frictionzoo.identification import problem
from frictionzoo.models import get_model, model_names
from frictionzoo.simulation.proof import Proof

VALUES = (float("nan"), float("inf"), None, "", 0, -1, 1e9, "absurd", [])
NAMED = VALUES[:4]  # what never is the matter of another option

FILES = "data=files bench=knee recipe=given"
REFUSED = {  # what is chosen, and arguments whose value is of another kind, or of a size that no memory holds
    "seed=0": f"""segments.count=nan loss.position=nan evaluation.horizons=[inf] loss.velocity=null
        loss.velocity={10**20} fit.iterations={2**31} seed={2**63} compilation_cache= data.cache_dir=
        bench.timestep=fast scale.torque=null scale.torque=0 scale=null bench.params.delay.scale=null
        bench.params.delay.high=inf""",
    FILES: f"""data.train=3 data.columns.qpos=3.5 data.columns=null data.where={{kp:[nan]}} data.sign.qpos=0
        data.units.supply=mile data.units.qpos=0 data.format=absurd data.clean.wrap= data.clean.order={10**9}
        bench.solreffriction=[0.02] bench.solreffriction=[0.02,1.0,1.0]""",
    "data=twin": f"""data.samples={10**9} data.excitation.harmonics=0 data.excitation.phase=[1.0]
        data.sensor.velocity_noise=-1""",
    "data=emps": "data.train=[a.mat] data.order=0",
    "fit=lm": f"fit.iterations={10**9}",
    "fit=auto": f"fit.tries={10**9}",
    "model=neural_friction": f"model.hidden=[{10**9}] model.hidden=[1.5]",
    "model=history_network": f"model.memory={10**9} model.time_constants=[0.1]",
    "model=maxwell_slip": f"model.elements={10**9}",
    "model=actuator_lstm": f"model.units={10**9} model.units=0",
}


def parse(argument: str) -> tuple[str, Any]:
    override = OverridesParser.create().parse_override(argument)
    return override.key_or_group, override.value()


@pytest.mark.parametrize(
    ("choices", "argument"), [(choices, each) for choices, text in REFUSED.items() for each in text.split()]
)
def test_an_absurd_value_is_refused_by_its_name(choices: str, argument: str) -> None:
    """Where options are checked, or where the section is built."""
    plain, (key, value) = compose_once(*choices.split()), parse(argument)
    changed = OmegaConf.create(OmegaConf.to_container(plain))
    OmegaConf.update(changed, key, value, merge=True)
    section = key.partition(".")[0]
    with pytest.raises(FrictionzooError, match=f"^{re.escape(key)}") as refused:
        check_overrides(changed, plain)
        build(OmegaConf.to_container(changed, resolve=True)[section], **({"nv": 1} if section == "model" else {}))
    assert "\n" not in str(refused.value)


@pytest.fixture
def judge(call: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str | None]:
    """Poses a problem with another value of an option: the line that refuses it, None for a run that begins.

    Nothing is compiled, and `call` undoes what a job does to JAX.
    """

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
    read, given = Given.read, {}

    def read_once(settings: Any) -> Given:
        sections = repr([settings.get(name) for name in ("data", "bench", "model")])
        found = given[sections] = given.get(sections) or read(settings)
        return found._replace(settings={**settings, "bench": found.settings["bench"]})

    monkeypatch.setattr(Given, "read", read_once)

    def judge(config: DictConfig, plain: DictConfig, key: str, value: Any) -> str | None:
        before = functools.reduce(operator.getitem, key.split("."), OmegaConf.to_container(config))
        try:
            OmegaConf.update(config, key, value)
            check_overrides(config, plain)
            job.run_job(config, "model", tmp_path / "run")
        except PosedError:
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
    "arguments",
    [
        *("data.clean.shortest=1e9", "data.clean.step=1e9", "data.clean.step=1e-9", "evaluation.local=1e9"),
        *("evaluation.trajectory=1e9", "evaluation.places=0", "bench.timestep=1e-9", f"loop.chunk={10**9}"),
        *("bench.params.delay={high:1e9,identify:true}", f"fit=grid model=mujoco_default fit.points={10**9}"),
        *(f"fit.iterations={10**9}", f"segments.count={10**9}"),
    ],
)
def test_a_problem_of_an_absurd_size_is_refused_by_its_option(judge, tiny, arguments):
    """Or begins: a fit of many iterations, as many segments as there are, and rollouts as long as the recordings."""
    *choices, last = arguments.split()
    key, value = parse(last)
    line = judge(compose_config(*tiny, *choices), compose_once(*FILES.split(), *choices), key, value)
    adapted = ("fit.iterations", "segments.count", "evaluation.local", "evaluation.trajectory")
    assert line is None if key in adapted else key in str(line)


NO_NAMES = ("nan", "0", "1e9", "null", "true", "[]", "[a,b]", "{}", "baseline,null", "range(1,3)")
NO_RANGES = ("range(1,1000000000)", "range(3,1)", "range(0,1,1e-9)", "range(1,9,0)")
ARGUMENTS = (
    *(f"{group}={value}" for group in ("model", "experiment", "variant", "hydra/launcher") for value in NO_NAMES),
    *(f"seed={values}" for values in NO_RANGES),
    *("hydra.run.dir=", "hydra.sweep.dir=''", "hydra.sweep.subdir=null", "hydra.verbose=nan"),
    *("data.train=[", "data.where={kp", "=3", "model=choice()"),
    # Files that are no choices of a group
    *("model=../evil", "model=/tmp/evil", "model@hydra.callbacks=../evil", "+experiment=../evil", "model=[lugre]"),
    *("hydra/launcher=../../evil", "data=files/x", "recipe='${oc.env:HOME}'", "start=../evil", "model=lugre.yaml"),
    *("model=lugre,../evil", "variant=../evil", "logger='../csv'", "../model=lugre"),
)


def test_an_argument_that_no_job_can_mean_is_refused() -> None:
    def check(argument: str) -> None:
        group = re.sub(r"^\+|@.*", "", argument.partition("=")[0])
        with pytest.raises(ConfigError, match=f"^{re.escape(group)}="):
            refuse_no_choice(["-m", argument])

    check_each(check, ARGUMENTS)
    refuse_no_choice(["-m", "model=baseline,lugre", "model=glob(*)", "experiment=emps,zoo", "hydra/launcher=joblib"])
    refuse_no_choice(["-m", "seed=range(5)", "fit.learning_rate=range(0.1,0.5,0.1)", "seed=range(5,1,-1)"])
    refuse_no_choice(["hydra.verbose=true", "hydra.verbose=[frictionzoo]", "hydra.run.dir=run"])


@pytest.mark.parametrize(
    ("read", "argument"),
    [
        (lambda argument: restore_overrides([argument]), "resume="),
        *[(lambda argument: read_number("timestep", argument[9:]), f"timestep={x}") for x in ("nan", "[1]")],
        *[(read_value, argument) for argument in ("seed=[", "fit.tries='", "loop={chunk")],
    ],
)
def test_a_value_that_cannot_be_read_is_refused(read: Callable, argument: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(argument)}"):
        read(argument)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("-m model=neural_friction,coulomb_smooth model.hidden=[4]", "model.hidden: unknown option with model=coulomb"),
        ("-m model=neural_friction,odd_network model.hidden=[4]", "write ++model.hidden=VALUE"),
        ("-m model=a,b model.hidden=[4]", "model=a: no such model"),
        ("model.params=[1]", "model.params=[1]: "),
    ],
)
def test_an_option_that_a_model_lacks_is_refused(call: Callable, tmp_path: Path, arguments: str, named: str) -> None:
    finished = call(*arguments.split(), "hydra.sweep.dir=sweep")
    assert finished.status == 2 and finished.out == "" and finished.err.count("\n") == 1
    assert named in finished.err and not (tmp_path / "sweep").exists()


ALIKE = ("delay", "static_torque")  # parameters that stand for all
LAWS = [name for name in model_names() if {*section_of(get_model(name))} - {"_target_", "params"}]
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
def test_no_value_of_any_option_is_a_traceback(judge, tiny, monkeypatch, choices, prefix):
    monkeypatch.setattr(loggers, "_require", lambda *packages: None)  # loggers whose package is not installed
    simulated = choices[0].startswith("data=t")
    small = [option for option in tiny if not (simulated and option.startswith("data"))]
    config, plain = compose_config(*small, *choices), compose_once(*FILES.split(), choices[0])
    plain = OmegaConf.create(OmegaConf.to_container(plain, resolve=True))  # resolving it each time took a tenth
    for key, value in absurd_values(prefix, config):
        line = judge(config, plain, key, value)
        # A number may be refused by what it leads to; what is none, only as itself.
        assert line is None or key in line or value not in NAMED, (key, value, line)
