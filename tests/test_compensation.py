"""Target `compensation`: its C code against the law, in a simulated drive, and in the hands of a compiler."""

import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.drawn import MODELS, draw, write

from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.export.c_source import run_compiled, write_literal, write_statements
from frictionzoo.export.compensation import FILE, FUNCTION
from frictionzoo.simulation.fold import specialise

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

# A drive with Coulomb friction that stops exactly, in steps of 20 microseconds: c is the compensation, f the friction.
SIMULATION = """
static void simulate(const double *in, double *out)
{
    const double step = 2e-5, inertia = 0.02, coulomb = %(frictionloss)r, viscous = %(damping)r;
    double v = in[0], left = 0, whole = 0, highest = 0;
    long i;
    for (i = 0; i < 100000; i++) {
        double motor = in[1] * sin(6.0 * i * step), c, push, before = fabs(v);
        friction_compensation_input now;
        now.qvel[0] = v;
        now.desired_velocity[0] = in[2];
        friction_compensation(&now, &c);
        push = motor + c - viscous * v;
        if (v == 0 && fabs(push) <= coulomb)
            push = 0;
        else {
            double side = v != 0 ? (v > 0) - (v < 0) : (push > 0) - (push < 0), next;
            push -= side * coulomb;
            next = v + step * push / inertia;
            if (fabs(v) > 0.1) {
                left += pow(side * coulomb + viscous * v - c, 2);
                whole += pow(side * coulomb + viscous * v, 2);
            }
            v = v * next < 0 ? 0 : next;
        }
        if (fabs(v) - before > highest)
            highest = fabs(v) - before;
    }
    out[0] = fabs(v);
    out[1] = highest;
    out[2] = whole > 0 ? sqrt(left / whole) : 0;
}
"""


def test_every_law_is_computed_as_the_model_does(tmp_path: Path):
    for name in MODELS:
        if name.endswith(("network", "neural_friction")):
            continue
        folder = tmp_path / name
        folder.mkdir()
        (difference,) = write("compensation", draw(name), folder, limit="1e3").differences
        assert difference.quantity == "torque" and difference.largest < 1e-9, name


def test_a_simulated_drive_keeps_little_of_its_friction_and_is_never_driven(tmp_path: Path):
    fitted = draw("mujoco_default")
    write("compensation", fitted, tmp_path)
    values = {name: float(value[0]) for name, value in fitted.values["friction"].items()}
    source = (tmp_path / FILE).read_text() + SIMULATION % values
    speeds = np.linspace(-3, 3, 13)
    coasting = run_compiled(source, "simulate", np.stack([speeds, 0 * speeds, 0 * speeds], axis=1), 3)
    assert (coasting[:, 1] == 0).all(), "faster without a motor"
    starting = run_compiled(source, "simulate", np.stack([0 * speeds, 0 * speeds, speeds], axis=1), 3)
    assert (starting[:, :2] == 0).all(), "started without a motor"
    moving = run_compiled(source, "simulate", np.array([[0.0, 0.3, 0.0], [1.0, 0.2, 1.0]]), 3)
    assert (moving[:, 0] > 0).any() and (moving[:, 2] > 0).all() and (moving[:, 2] < 0.1).all()


def test_limits_dead_band_and_inputs_that_are_not_finite(tmp_path: Path):
    write("compensation", draw("mujoco_default"), tmp_path, limit="0.01", dead_band="0.5", gain="0.5")
    source = (tmp_path / FILE).read_text()
    rows = [[3.0, 0.0], [-3.0, 0.0], [0.0, 0.0], [np.nan, 1.0], [1.0, np.inf]]
    torque = run_compiled(source, FUNCTION, np.array(rows), 1)[:, 0]
    assert torque.tolist() == [0.01, -0.01, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("option", ["gain=0", "gain=1.1", "gain=nan", "dead_band=0", "dead_band=-1", "limit=0"])
def test_options_outside_their_range_are_refused(tmp_path: Path, option: str):
    name, value = option.split("=")
    with pytest.raises(ConfigError, match=name):
        write("compensation", draw("mujoco_default"), tmp_path, **{name: value})


def test_more_torque_than_friction_is_refused(tmp_path: Path):
    with pytest.raises(ExportError, match="dead_band"):  # friction that grows with a power of the speed
        write("compensation", draw("polynomial_viscous"), tmp_path, dead_band="1e3", limit="1e12")


def test_a_formula_too_long_for_a_controller_is_refused(tmp_path: Path):
    with pytest.raises(ExportError, match="distil"):
        write("compensation", draw("neural_friction"), tmp_path)


@pytest.mark.parametrize("law", ["mujoco_default", "directional"])
def test_compilers_have_nothing_to_say(tmp_path: Path, law: str):
    write("compensation", draw(law), tmp_path)
    use = "int main(void) { static friction_compensation_input in; double out; friction_compensation(&in, &out); "
    (tmp_path / "use.c").write_text(f'#include "{FILE}"\n{use}return out > 0; }}\n')
    for command in (["cc", "-std=c99"], ["c++", "-x", "c++", "-std=c++11"]):
        flags = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", "use.c"]
        subprocess.run([*command, *flags], cwd=tmp_path, check=True)


def test_operations_are_those_of_jax():
    def every(a, b):
        large, other = jnp.where((a > b) & ~(a < 0) | (b != 1), a, b), jnp.where(a >= b, jnp.sign(a), -b)
        some = jnp.exp(-jnp.abs(a)) + jnp.log1p(b**2) + jnp.sqrt(jnp.abs(b)) * jnp.tanh(a) + jnp.sin(a) * jnp.cos(b)
        return some + large / (2 + other**2) + jnp.maximum(a, 0.1) - jnp.minimum(b, -0.1) + jnp.fmod(a, 0.7) + a[::-1]

    folded = specialise(every, np.zeros(3), np.zeros(3))
    used, lines = write_statements(folded, ["a", "b"], "out")
    assert used == {"a", "b"}
    body = "\n".join(lines)
    source = (
        "#include <math.h>\ntypedef struct { double a[3], b[3]; } input;\n"
        f"static void every(const input *in, double *out)\n{{\n{body}\n}}\n"
    )
    inputs = np.random.default_rng(0).normal(size=(500, 6))
    inputs[:3] = 0
    with jax.enable_x64(True):
        expected = np.asarray(jax.vmap(every)(inputs[:, :3], inputs[:, 3:]))
    assert np.abs(run_compiled(source, "every", inputs, 3) - expected).max() < 1e-13


def test_a_name_is_data():
    for name in ('"); system("x', "*/ int main", "??/", "käfer\n", "a\\"):
        literal = write_literal(name)
        assert literal.isascii() and "\n" not in literal and '"' not in literal[1:-1] and "?" not in literal
        assert literal[1:-1].encode().decode("unicode_escape").encode("latin1").decode() == name
