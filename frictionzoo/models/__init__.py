"""Friction laws, one a file; importing this package registers all of them."""

from frictionzoo.models.asymmetric import Asymmetric
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.baseline import Baseline
from frictionzoo.models.coulomb_smooth import CoulombSmooth
from frictionzoo.models.coulomb_stribeck import CoulombStribeck
from frictionzoo.models.dahl import Dahl
from frictionzoo.models.lugre import LuGre
from frictionzoo.models.maxwell_slip import MaxwellSlip
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.models.polynomial_viscous import PolynomialViscous
from frictionzoo.models.registry import get_model, model_names, register_model
from frictionzoo.models.ripple import Ripple

__all__ = [
    "Asymmetric",
    "Baseline",
    "CoulombSmooth",
    "CoulombStribeck",
    "Dahl",
    "FrictionModel",
    "LuGre",
    "MaxwellSlip",
    "MujocoDefault",
    "NeuralFriction",
    "PolynomialViscous",
    "Ripple",
    "get_model",
    "model_names",
    "register_model",
]
