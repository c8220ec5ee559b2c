"""Which runs can be compared, what the comparison says, and its command."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from helpers.curves import HARD, ROLLOUTS, make_curves
from helpers.results import VALUES, build

from frictionzoo.api.comparison_files import write_comparison
from frictionzoo.cli.finished import compare as main
from frictionzoo.core.errors import RunError
from frictionzoo.core.output import to_json, write_json
from frictionzoo.result.comparison.record import compare_runs, read_schema
from frictionzoo.result.comparison.runs import Failure, read_runs
from frictionzoo.result.curves import read_curves, write_curves
from frictionzoo.result.portrait import Portrait


@pytest.fixture
def record(bench, model, dataset, evaluation):
    return build(bench, model, dataset, evaluation, VALUES)


@pytest.fixture
def save(record, tmp_path):
    """Writes the folder of a run of a model with these errors of its test rollouts."""

    def save(name, law, errors, identified=(), **changes):
        result = to_json(record) | {"model": law}
        for parameter in result["parameters"]:
            (knee,) = parameter["by_joint"]
            parameter["identified"] = knee["identified"] = parameter["name"] in ("armature", *identified)
        finite = np.asarray(errors)[np.isfinite(errors)]
        result["metrics"]["test"] |= {
            "position_mae": float(finite.mean()) if len(finite) else None,
            "position_mae_std": float(finite.std()) if len(finite) else None,
            "rollouts": len(errors),
            "diverged": len(errors) - len(finite),
        }
        for path, value in changes.items():
            *sections, key = path.split("__")
            inner = result
            for section in sections:
                inner = inner.setdefault(section, {})
            inner[key] = value
        folder = tmp_path / "sweep" / name
        folder.mkdir(parents=True)
        write_json(folder / "result.json", result)
        write_curves(folder, make_curves(errors))
        return folder

    return save


@pytest.fixture
def zoo(save):
    """A sweep: no friction, a simple law, one with more parameters that is better by less than noise, a clumsy one."""
    noise = 1e-3 * np.resize([1, -1], ROLLOUTS)
    save("0_baseline", "baseline", HARD + 0.03)
    save("1_simple", "simple", HARD, ["static_torque"])
    save("2_rich", "rich", HARD - 1e-5 + noise, ["static_torque", "kinetic_torque", "stribeck_velocity"])
    return save("10_clumsy", "clumsy", HARD + 0.004, ["static_torque", "kinetic_torque"]).parent


def compare(folder):
    return compare_runs(*read_runs([folder]))


def test_a_sweep_is_compared_in_the_order_of_the_errors(zoo):
    comparison = compare(zoo)
    assert [run["label"] for run in comparison["runs"]] == ["rich", "simple", "clumsy", "baseline"]
    assert comparison["reference"] == "baseline"
    for run in comparison["runs"]:
        assert run["change"]["test"] == pytest.approx(run["test"]["position_mae"] / (HARD.mean() + 0.03) - 1, rel=1e-12)
    assert [run["identified"] for run in comparison["runs"]] == [4, 2, 3, 1]
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(comparison))


def test_the_simplest_within_noise_is_recommended_with_the_reason(zoo):
    recommendation = compare(zoo)["recommendation"]
    assert (recommendation["run"], recommendation["best"]) == ("simple", "rich")
    assert recommendation["unidentifiable"] == [] and "dentifiable" not in recommendation["reason"]
    assert "within noise" in recommendation["reason"] and "with 2 identified values" in recommendation["reason"]


def test_a_recommendation_by_a_hair_says_so(zoo, save):
    assert "limit of noise" not in compare(zoo)["recommendation"]["reason"]
    spread = 1e-3 * np.resize([1.0, -1.0], ROLLOUTS)
    for share, how in ((1.85, "within noise"), (2.2, "worse")):  # about two standard errors of the mean
        shutil.rmtree(zoo / "2_rich")
        better = HARD - share * 1e-3 / np.sqrt(ROLLOUTS) + spread
        save("2_rich", "rich", better, ["static_torque", "kinetic_torque", "stribeck_velocity"])
        comparison = compare(zoo)
        (pair,) = (p for p in comparison["pairs"] if (p["run"], p["other"]) == ("simple", "rich"))
        assert pair["verdict"] == ("worse" if how == "worse" else "noise")
        assert f"limit of noise: simple ({how})" in comparison["recommendation"]["reason"]


def test_what_the_recommended_law_leaves_open_is_named(zoo):
    leave_open(zoo / "1_simple", "static_torque")
    leave_open(zoo / "2_rich", "static_torque")
    recommendation = compare(zoo)["recommendation"]
    assert recommendation["run"] == "simple" and recommendation["unidentifiable"] == ["friction.static_torque"]
    assert "Not identifiable, do not interpret these values: friction.static_torque." in recommendation["reason"]


def leave_open(folder, name):
    """Have the data not determine one parameter of a run."""
    result = json.loads((folder / "result.json").read_text())
    for parameter in result["parameters"]:
        (knee,) = parameter["by_joint"]
        parameter["identifiable"] = knee["identifiable"] = parameter["name"] != name
    (folder / "result.json").write_text(json.dumps(result))


def test_a_tie_goes_to_the_simplest_whose_parameters_are_all_identifiable(zoo, save):
    leave_open(zoo / "1_simple", "static_torque")
    recommendation = compare(zoo)["recommendation"]
    assert recommendation["run"] == "rich" and recommendation["unidentifiable"] == []
    assert "Fewer values, but not all identifiable: simple." in recommendation["reason"]
    save("3_net", "net", HARD - 2e-5, network={"weights": 1})  # its weights are never identifiable
    recommendation = compare(zoo)["recommendation"]
    assert (recommendation["run"], recommendation["best"]) == ("rich", "net")


def test_a_clear_winner_is_recommended_however_rich(zoo, save):
    shutil.rmtree(zoo / "2_rich")
    save("2_rich", "rich", HARD / 2, ["static_torque", "kinetic_torque", "stribeck_velocity"])
    recommendation = compare(zoo)["recommendation"]
    assert recommendation["run"] == recommendation["best"] == "rich"
    assert "all other runs are worse by more than noise" in recommendation["reason"]


def test_a_recommended_network_is_said_to_predict_and_not_to_identify(zoo, save):
    save("3_net", "net", HARD / 2, network={"weights": 9})
    recommendation = compare(zoo)["recommendation"]
    assert recommendation["run"] == "net" and "with 10 identified values" in recommendation["reason"]
    assert "do not interpret its physical parameters" in recommendation["reason"]


def test_pairs_are_judged_by_what_they_share(zoo):
    verdicts = {(pair["run"], pair["other"]): pair["verdict"] for pair in compare(zoo)["pairs"]}
    assert len(verdicts) == 6
    assert verdicts["simple", "rich"] == "noise"
    assert verdicts["clumsy", "simple"] == verdicts["baseline", "rich"] == "worse"


def test_few_rollouts_are_said(save):
    folder = save("0_simple", "simple", HARD[:4]).parent
    assert "Few rollouts (4)" in compare(folder)["recommendation"]["reason"]


def test_a_run_that_diverged_comes_last_and_is_not_recommended(zoo, save):
    save("3_wild", "wild", np.where(np.arange(ROLLOUTS) == 3, np.nan, HARD / 10))
    comparison = compare(zoo)
    assert comparison["runs"][-1]["label"] == "wild" and comparison["recommendation"]["run"] == "simple"
    comparison = compare(save("4_lost", "lost", np.full(ROLLOUTS, np.nan)))
    assert comparison["recommendation"] is None and comparison["runs"][0]["change"]["test"] is None
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(comparison))


def test_without_a_baseline_each_run_is_measured_against_its_own(zoo):
    shutil.rmtree(zoo / "0_baseline")
    comparison = compare(zoo)
    without = read_runs([zoo])[0][0].result["metrics"]["baseline"]["position_mae"]
    assert comparison["reference"] is None
    for run in comparison["runs"]:
        assert run["change"]["test"] == pytest.approx(run["test"]["position_mae"] / without - 1, rel=1e-12)
        assert run["change"]["train"] is None


def test_curves_are_those_of_the_runs(zoo):
    comparison = compare(zoo)
    curves = read_curves(zoo / "1_simple")
    np.testing.assert_allclose(comparison["friction"]["simple"]["torque"], curves.friction.T)
    by_speed, by_load = comparison["by_speed"], comparison["by_load"]
    assert by_speed["windows"] == by_load["windows"] == [5] * 8
    np.testing.assert_allclose(by_speed["position_mae"]["simple"][0], curves.local_mae[:5].mean())
    np.testing.assert_allclose(by_load["position_mae"]["simple"][0], curves.local_mae[-5:].mean())
    # The drift grows linearly to the error of the first rollout, so its mean up to the end is half of that.
    end = comparison["by_horizon"]["position_mae"]["simple"][-1]
    assert end == pytest.approx(HARD[0] / 2, rel=1e-9)


def test_options_that_differ_are_listed(zoo, save):
    save("5_other", "other", HARD, settings__segments__length=9)
    (entry,) = compare(zoo)["differences"]
    assert entry["option"] == "segments.length"
    assert entry["values"] == {"rich": 5, "simple": 5, "other": 9, "clumsy": 5, "baseline": 5}


def test_runs_of_one_model_are_told_apart(save):
    save("0_a", "law", HARD, settings__segments__length=20)
    folder = save("1_a", "law", HARD, settings__segments__length=[5, 9], settings__loss__robust=None).parent
    labels = [run.label for run in read_runs([folder])[0]]
    assert labels == ["law, segments.length 20", "law, segments.length 5 9"]
    save("2_a", "law", HARD, settings__segments__length=20)
    assert [run.label for run in read_runs([folder])[0]] == ["law (0_a)", "law (1_a)", "law (2_a)"]


@pytest.fixture
def save_seeds(save):
    """Writes runs of a model that differ only in the seed: errors of the test rollouts by seed, and in training."""

    def save_seeds(law, errors, training=(0.3, 0.1, 0.2)):
        for seed, (error, train) in enumerate(zip(errors, training, strict=True)):
            options = {"seed": seed, "settings__seed": seed, "settings__model__seed": seed}
            options |= {"settings__evaluation__seed": 0, "metrics__train__position_mae": train}
            folder = save(f"{law}_{seed}", law, error, **options)
        return folder.parent

    return save_seeds


def test_seeds_are_one_row_with_mean_and_standard_deviation(zoo, save_seeds):
    save_seeds("net", [HARD, HARD + 0.003, HARD + 0.006])
    comparison = compare(zoo)
    (row,) = (run for run in comparison["runs"] if run["model"] == "net")
    assert row["label"] == "net" and len(comparison["runs"]) == 5
    assert [(row["option"], row["values"]["net"]) for row in comparison["differences"]] == [("seed", [0, 1, 2])]
    assert row["test"]["position_mae"] == pytest.approx(HARD.mean() + 0.003)
    assert row["train"]["position_mae"] == pytest.approx(0.2)
    np.testing.assert_allclose(row["rollout_mae"], HARD + 0.003)
    seeds = row["seeds"]
    assert seeds["test_std"] == pytest.approx(0.003) and not seeds["deterministic"]
    assert seeds["values"] == [0, 1, 2] and seeds["runs"] == ["net_1", "net_2", "net_0"]
    assert row["run"] == "net_1" and row["settings"]["seed"] == 1  # the lowest training error
    end = comparison["by_horizon"]["position_mae"]["net"][-1]
    assert end == pytest.approx((HARD[0] + 0.003) / 2, rel=1e-9)
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(comparison))


def test_the_interval_contains_the_spread_of_the_seeds(save, save_seeds):
    save("0_law", "law", HARD)
    folder = save_seeds("steady", [HARD + 0.005 + step for step in (-1e-4, 0, 1e-4)])
    save_seeds("random", [HARD + 0.005 + step for step in (-9e-3, 0, 9e-3)])
    pairs = {pair["run"]: pair for pair in compare(folder)["pairs"] if pair["other"] == "law"}
    assert (pairs["steady"]["verdict"], pairs["random"]["verdict"]) == ("worse", "noise")
    half = 4.302652729911 * 9e-3 / np.sqrt(3)  # Student's quantile with two degrees of freedom
    assert pairs["random"]["high"] - pairs["random"]["mean"] == pytest.approx(half, rel=1e-6)


def test_a_rollout_that_diverged_with_one_seed_counts(zoo, save_seeds):
    save_seeds("net", [HARD / 9, np.where(np.arange(ROLLOUTS) == 3, np.nan, HARD / 9), HARD / 9])
    row = compare(zoo)["runs"][-1]
    assert (row["label"], row["test"]["diverged"]) == ("net", 1)


def test_a_seed_is_averaged_once_and_only_with_equal_options(save, save_seeds):
    folder = save_seeds("net", [HARD] * 3)
    save("again", "net", HARD, seed=1, settings__seed=1)
    save("other", "net", HARD, seed=3, settings__seed=3, settings__model__seed=3, settings__dtype=64)
    runs = compare(folder)["runs"]
    assert sorted(len(run["seeds"]["values"]) if run["seeds"] else 1 for run in runs) == [1, 1, 3]


def test_automatic_settings_may_depend_on_the_seed(save):
    for seed in (0, 1):
        chosen = {"option": "segments.length", "value": 5 + seed, "reason": "found in pilot fits"}
        options = {"seed": seed, "settings__seed": seed, "settings__segments__length": 5 + seed}
        folder = save(f"{seed}_law", "law", HARD, **options, recipe=[chosen]).parent
    assert [run["seeds"]["values"] for run in compare(folder)["runs"]] == [[0, 1]]
    save("2_law", "law", HARD, seed=2, settings__seed=2, settings__segments__length=9)  # given
    assert len(compare(folder)["runs"]) == 2


def test_equal_results_of_all_seeds_are_one_deterministic_run(save, save_seeds, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("frictionzoo.report.comparison_plots.write_figures", lambda *_: None)
    save_seeds("law", [HARD] * 3, training=[0.1] * 3)
    save_seeds("net", [HARD + 0.01, HARD + 0.012, HARD + 0.014])
    folder = save("2_other", "other", HARD + 0.1).parent
    main([str(folder)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("5 runs on ")  # one, three, and one
    assert [line.split()[0] for line in lines[3:6]] == ["law", "net", "other"]
    page = (folder / "comparison" / "comparison.html").read_text()
    table = (folder / "comparison" / "table.tex").read_text()
    texts = {"".join(lines): "3 seeds +- 0.002", page: "3 seeds ± 0.002", table: r"3 seeds $\pm$ 2.00"}
    for text, seeds in texts.items():
        assert seeds in text and "seed=" not in text
        assert text.count("& deterministic &" if text is table else "deterministic") == 1


def test_folders_may_be_runs_and_sweeps_and_count_once(zoo):
    runs, failures = read_runs([zoo / "1_simple", zoo, zoo / "../sweep/10_clumsy"])
    assert [run.folder.name for run in runs] == ["1_simple", "0_baseline", "2_rich", "10_clumsy"]
    assert not failures


def test_failures_are_listed_with_their_reason(zoo):
    for name in ("3_failed", "4_killed"):
        (zoo / name / ".hydra").mkdir(parents=True)
    (zoo / "3_failed" / "failure.json").write_text(json.dumps({"model": "bad", "reason": "no\n good"}))
    assert read_runs([zoo])[1] == [
        Failure("3_failed", "bad", "no good"),
        Failure("4_killed", "", "no result: its process ended before it was done"),
    ]
    comparison = compare(zoo)
    assert [failure["run"] for failure in comparison["failures"]] == ["3_failed", "4_killed"]
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(comparison))


def test_other_data_are_refused(zoo, save, record):
    data = to_json(record.data) | {"name": "storm", "sha256": 64 * "f"}
    save("5_other", "other", HARD, data=data)
    with pytest.raises(
        RunError, match=r"5_other: data storm \(SHA-256 ffffffffffff\), expected waves .* as in .*0_base"
    ):
        read_runs([zoo])


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"horizons": [0.5]}, r"evaluation.horizons=\[0.5\], expected \[0.1\] as in"),
        ({"horizons": [0.1]}, "rollouts differ from"),
    ],
    ids=["named", "unnamed"],
)
def test_other_rollouts_are_refused(save, settings, text):
    save("0_first", "first", HARD, settings__evaluation={"horizons": [0.1]})
    folder = save("1_other", "other", HARD, settings__evaluation=settings, evaluation__sha256=64 * "f").parent
    with pytest.raises(RunError, match=text):
        read_runs([folder])


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("result.json", b"{", "not JSON"),
        ("result.json", b"\xff", "not JSON"),
        ("result.json", b"[]", "list, expected an object"),
        ("result.json", b'{"schema_version": 1}', "schema_version 1, expected 10; run it again"),
        ("result.json", b'{"schema_version": 10}', "missing required field"),
        ("curves.safetensors", b"", "expected the file that this version writes"),
        ("curves.safetensors", b"\x80\x04pickle", "expected the file that this version writes"),
        ("failure.json", b"7", "int, expected an object"),
    ],
)
def test_a_damaged_file_is_one_clear_line(zoo, name, content, text):
    if name == "failure.json":
        (zoo / "1_simple" / "result.json").unlink()
    (zoo / "1_simple" / name).write_bytes(content)
    with pytest.raises(RunError, match=text) as caught:
        read_runs([zoo])
    assert "\n" not in str(caught.value) and str(zoo / "1_simple" / name) in str(caught.value)


def test_curves_of_another_shape_and_missing_ones_are_refused(zoo):
    curves = read_curves(zoo / "1_simple")
    write_curves(zoo / "1_simple", replace(curves, test_mae=curves.test_mae[:3]))
    with pytest.raises(RunError, match=r"1_simple: test_mae of shape \(3,\), expected \(10,\)"):
        read_runs([zoo])
    (zoo / "1_simple" / "curves.safetensors").unlink()
    with pytest.raises(RunError, match="No such file"):
        read_runs([zoo])


def test_runs_may_differ_in_what_is_their_own(zoo):
    """One law sees more, leaves torque up to another frequency, and lost a training rollout."""
    curves, own = read_curves(zoo / "1_simple"), {"left": np.ones((7, 1)), "left_time": np.arange(7.0)}
    portraits = {"load": Portrait(*np.ones((8, 3, 1)))}
    own |= {"portraits": portraits, "train_errors": np.ones((4, 5, 1))}
    write_curves(zoo / "1_simple", replace(curves, **own))
    assert compare(zoo) and len(read_runs([zoo])[0]) == 4


def test_the_command_writes_into_the_folder_and_prints_the_table(zoo, capsys, monkeypatch):
    monkeypatch.chdir(zoo.parent)
    drawn = []
    figures = "frictionzoo.report.comparison_plots.write_figures"
    monkeypatch.setattr(figures, lambda folder, *_: drawn.append(str(folder)))
    main(["sweep"])
    written = json.loads(Path("sweep/comparison/comparison.json").read_text())
    jsonschema.Draft202012Validator(read_schema()).validate(written)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[3:7]] == ["rich", "simple", "clumsy", "baseline"]
    assert "recommended: simple." in "\n".join(lines) and lines[-1] == "files: sweep/comparison"
    # Again, with the comparison already there, and elsewhere.
    main(["sweep", "sweep/1_simple", "--output", "there"])
    assert (Path("there/comparison.json").read_bytes()) == Path("sweep/comparison/comparison.json").read_bytes()
    assert drawn == ["sweep/comparison/figures", "there/figures"]


@pytest.mark.parametrize("folder", ["nowhere", "."], ids=["missing", "empty"])
def test_a_folder_without_a_run_is_one_line_and_leaves_nothing(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main([folder])
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith(f"frictionzoo: {folder}: no run in it")
    assert len(captured.err.splitlines()) == 1 and not list(tmp_path.iterdir())


def test_a_sweep_without_a_result_is_refused_with_the_reasons(tmp_path):
    folder = tmp_path / "0_failed"
    folder.mkdir()
    (folder / "failure.json").write_text(json.dumps({"model": "bad", "reason": "out of luck"}))
    with pytest.raises(RunError, match="0_failed: out of luck"):
        write_comparison([tmp_path], tmp_path / "comparison")
    assert not (tmp_path / "comparison").exists()
