"""The quickest run of every benchmark."""

from conftest import BRIEF, ROOT

TWIN = "data.samples=12000 data.split.gap=0.05"
FEW = f"segments.count=20 discretisation=false {' '.join(f'{key}={value}' for key, value in BRIEF.items())}"
LOG = f"--more recipe=given loop.progress=false fit.iterations=2 {FEW}"
QUICKEST = {  # script: its arguments, and the rows that it has to give
    "gradient": ("--quick --joints 1 --ways mjx.step-unfused", 6),
    "start": ("--repeats 1 --commands help 'no such recording'", 2),
    "sysid": ("--samples 2000 --repeats 1", 4),
    "reports": ("--samples 20000 --sequences 1 --repeats 1", 2),
    "end_to_end": (f"--models baseline --iterations 2 -- {TWIN} {FEW}", 1),
    "grid": ("--points 2 --sample 1 --models mujoco_default -- data.samples=12000", 4),
    "torch_loop": (f"--laws coulomb_stribeck neural_friction --iterations 2 -- {TWIN} {FEW}", 6),
    "torch_only": ("--quick --engines specialised", 3),
    "robot": ("--variants torque --parts legs --segments 4 --length 10 --iterations 2 --seconds 0.5", 3),
    "whole_robot": (f"{ROOT}/frictionzoo/bench/assets/knee_rod.xml --recordings 2 --seconds 2 --segments 5", 1),
    "arm": ("--bandwidths 40 --recordings 1 --seconds 3 --sure 0.1", 5),
    "branches": ("--segments 4 --length 10 --dtypes float64", 2),
    "newcomer": (f"--drives 1 --kinds sticking {LOG}", 1),
    "causes": (f"--causes lag --drives 1 {LOG}", 1),
    "coverage": ("--cases rounded load --logs 2 --recordings 2", 2),
    "drift": ("--logs 2 --changes 0 --seconds 4", 1),
    "recipe": (f"--cases twin -- {TWIN} {FEW} segments.length=50 fit.iterations=2", 1),
    "checkup": ("--data twin_clean --good twin_clean --most 1", 22),
    "excitation": (f"--starts 1 --iterations 2 --period 2 -- {TWIN} {FEW} segments.length=100 fit.iterations=3", 5),
    "growth": ("--samples 1e4 --lengths --widths 16 --segments 200", 2),
}
