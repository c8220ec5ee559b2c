"""The LaTeX table of a comparison: its structure, its numbers, and users' texts that mean something to TeX."""

import re

import pytest
from conftest import put

from frictionzoo.report.latex import escape, tabulate_latex
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import Failure, gather

LABELS = ("stribeck", "smooth", "baseline")
HOSTILE = r"""a_b $x$ \input{/etc/hosts} 50% & {#1} ~^ <>| "q" [x]"""


def rows_of(table):
    body = table.split(r"\midrule")[1].split(r"\bottomrule")[0]
    return [line.strip().removesuffix(r"\\") for line in body.strip().splitlines()]


def cells_of(row):
    return [cell.strip() for cell in re.split(r"(?<!\\)&", row)]


def judge_structure(table):
    """Environments and braces close in order, and every row has as many cells as there are columns."""
    opened = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", table):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    code = re.sub(r"(?m)^%.*$", "", table)
    assert not re.search(r"(?<!\\)[%#]", code)
    assert len(re.findall(r"(?<!\\)\$", code)) % 2 == 0
    assert len(re.findall(r"(?<!\\)\{", code)) == len(re.findall(r"(?<!\\)\}", code))
    columns = len(re.search(r"\\begin\{tabular\}\{@\{\}([lr]+)@\{\}\}", code)[1])
    assert [len(cells_of(row)) for row in rows_of(code)] == [columns] * len(rows_of(code))
    heads = code.split(r"\toprule")[1].split(r"\midrule")[0]
    heads = [
        re.sub(r"\\multicolumn\{(\d)\}", lambda wide: "&" * (int(wide[1]) - 1), line)
        for line in heads.splitlines()
        if line.endswith(r"\\")
    ]
    assert [len(cells_of(head)) for head in heads] == [columns, columns]


@pytest.fixture
def comparison(make_runs):
    return compare_runs(make_runs(LABELS), [])


def test_table_holds_the_numbers(comparison):
    table = tabulate_latex(comparison)
    judge_structure(table)
    assert r"position MAE [$10^{-3}$ rad]" in table
    for row, run in zip(rows_of(table), comparison["runs"], strict=True):
        label, values, train, test, change, fit = cells_of(row)
        assert label.startswith(run["label"])
        assert int(values) == run["identified"] == 1
        assert float(train) == pytest.approx(1e3 * run["train"]["position_mae"], abs=0.0051)
        mae, sigma = map(float, re.search(r"([\d.]+) \(([\d.]+)\)", test).groups())
        assert mae == pytest.approx(1e3 * run["test"]["position_mae"], abs=0.0051)
        assert sigma == pytest.approx(1e3 * run["test"]["position_mae_std"], abs=0.0051)
        expected = "--" if run["label"] == "baseline" else f"${100 * run['change']['test']:+.0f}$"
        assert (change, fit) == (expected, "3.2")
    assert r"\caption{" in table and r"\label{" in table
    assert "waves (simulated data)" in table and "against baseline" in table


def test_best_recommended_and_equal_are_marked(comparison):
    comparison.recommendation.run, comparison.recommendation.best = "smooth", "stribeck"
    pair = next(pair for pair in comparison["pairs"] if (pair["run"], pair["other"]) == ("smooth", "stribeck"))
    pair.verdict = "noise"
    rows = rows_of(tabulate_latex(comparison))
    assert [r"\textbf" in row for row in rows] == [True, False, False]
    assert [r"\dagger" in row for row in rows] == [False, True, False]
    assert [r"\ast" in row for row in rows] == [False, True, False]
    pair.verdict = "worse"
    comparison.recommendation.run = "stribeck"
    rows = rows_of(tabulate_latex(comparison))
    assert [r"\dagger" in row for row in rows] == [False, False, False]
    assert [r"\ast" in row for row in rows] == [True, False, False]


def test_seeds_have_a_column(make_runs):
    runs = make_runs(["smooth", "smooth", "baseline"])
    for seed, run in enumerate(runs):
        put(run.result, "seed", seed)
    comparison = compare_runs(gather(runs), [])
    table = tabulate_latex(comparison)
    judge_structure(table)
    spread = 1e3 * comparison["runs"][0]["seeds"]["test_std"]
    assert [cells_of(row)[4] for row in rows_of(table)] == [rf"2 seeds $\pm$ {spread:.2f}", ""]
    assert "Seeds:" in table and cells_of(rows_of(table)[0])[0] == "smooth" + r"$^{\ast}$"


def test_without_a_reference_the_caption_says_so(make_runs):
    table = tabulate_latex(compare_runs(make_runs(["smooth", "stribeck"]), []))
    judge_structure(table)
    assert "against the same drive identified without friction" in table
    assert all(re.fullmatch(r"\$[+-]\d+\$", cells_of(row)[4]) for row in rows_of(table))


def test_what_diverged_or_failed_is_noted(make_runs):
    failures = [Failure("3_lugre", "lugre", "out of memory"), Failure("4_x", "", "no result: its process ended")]
    comparison = compare_runs(make_runs(("good", "lost"), diverged="lost"), failures)
    table = tabulate_latex(comparison)
    judge_structure(table)
    assert cells_of(rows_of(table)[1])[2:5] == ["--", "--", "--"]
    assert "lost, 6 of 6 on train data; lost, 6 of 6 on test data." in table
    assert rf"No result: {escape('3_lugre')} (lugre): out of memory; {escape('4_x')}: no result" in table


def test_where_all_diverged_nothing_is_best(make_runs):
    table = tabulate_latex(compare_runs(make_runs(["lost"], diverged="lost"), []))
    judge_structure(table)
    assert r"\textbf" not in table and "position MAE [rad]" in table


def test_users_texts_are_only_text(make_runs):
    runs = make_runs(("[*first", HOSTILE, "baseline"))
    comparison = compare_runs(runs, [Failure(HOSTILE, HOSTILE, f"two\nlines {HOSTILE}")])
    comparison.data.name = HOSTILE
    table = tabulate_latex(comparison)
    judge_structure(table)
    assert r"\input" not in table
    assert rows_of(table)[0].startswith("{[}{*}first")  # or the end of the line before would take them as arguments
    assert cells_of(rows_of(table)[1])[0].startswith(escape(HOSTILE))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(("a&b", r"a\&b"), ("50%", r"50\%"), ("$x$", r"\$x\$"), ("{\\x}", r"\{\textbackslash{}x\}")),
        *(("~^", r"\textasciitilde{}\textasciicircum{}"), ("a--b", "a{-}{-}b"), ("two\n\nlines", "two lines")),
        *(("größer", "größer"), ("\x1b[31mred", "{[}31mred")),
    ],
)
def test_escape(text, expected):
    assert escape(text) == expected


def test_a_huge_error_is_a_power_of_ten(comparison):
    comparison.runs[-1].test.position_mae = 2.5e30
    table = tabulate_latex(comparison)
    judge_structure(table)
    assert r"$2.50\times10^{33}$" in rows_of(table)[-1]
