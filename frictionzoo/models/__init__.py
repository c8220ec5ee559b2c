"""Friction laws, one a file; importing this package registers all of them."""

from frictionzoo.models.base import FrictionModel
from frictionzoo.models.baseline import Baseline
from frictionzoo.models.coulomb_smooth import CoulombSmooth
from frictionzoo.models.coulomb_stribeck import CoulombStribeck
from frictionzoo.models.dissipative_network import DissipativeNetwork
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.models.odd_network import OddNetwork
from frictionzoo.models.registry import get_model, model_names, register_model
from frictionzoo.models.residual_network import ResidualNetwork

__all__ = [
    "Baseline",
    "CoulombSmooth",
    "CoulombStribeck",
    "DissipativeNetwork",
    "FrictionModel",
    "MujocoDefault",
    "NeuralFriction",
    "OddNetwork",
    "ResidualNetwork",
    "get_model",
    "model_names",
    "register_model",
]
