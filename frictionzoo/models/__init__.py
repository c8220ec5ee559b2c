"""Friction laws, one a file; importing this package registers all of them."""

from frictionzoo.models.asymmetric import Asymmetric
from frictionzoo.models.backlash import Backlash
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.baseline import Baseline
from frictionzoo.models.coulomb_smooth import CoulombSmooth
from frictionzoo.models.coulomb_stribeck import CoulombStribeck
from frictionzoo.models.dahl import Dahl
from frictionzoo.models.directional import Directional
from frictionzoo.models.dissipative_network import DissipativeNetwork
from frictionzoo.models.harmonic_drive import HarmonicDrive
from frictionzoo.models.history_network import HistoryNetwork
from frictionzoo.models.load_dependent import LoadDependent
from frictionzoo.models.lugre import LuGre
from frictionzoo.models.maxwell_slip import MaxwellSlip
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.models.odd_network import OddNetwork
from frictionzoo.models.polynomial_viscous import PolynomialViscous
from frictionzoo.models.quadratic import Quadratic
from frictionzoo.models.registry import get_model, model_names, register_model
from frictionzoo.models.residual_network import ResidualNetwork
from frictionzoo.models.ripple import Ripple
from frictionzoo.models.stribeck import Stribeck
from frictionzoo.models.stribeck_load_dependent import StribeckLoadDependent
from frictionzoo.models.temperature_arrhenius import TemperatureArrhenius
from frictionzoo.models.temperature_linear import TemperatureLinear
from frictionzoo.models.torch_friction import TorchFriction

__all__ = [
    "Asymmetric",
    "Backlash",
    "Baseline",
    "CoulombSmooth",
    "CoulombStribeck",
    "Dahl",
    "Directional",
    "DissipativeNetwork",
    "FrictionModel",
    "HarmonicDrive",
    "HistoryNetwork",
    "LoadDependent",
    "LuGre",
    "MaxwellSlip",
    "MujocoDefault",
    "NeuralFriction",
    "OddNetwork",
    "PolynomialViscous",
    "Quadratic",
    "ResidualNetwork",
    "Ripple",
    "Stribeck",
    "StribeckLoadDependent",
    "TemperatureArrhenius",
    "TemperatureLinear",
    "TorchFriction",
    "get_model",
    "model_names",
    "register_model",
]
