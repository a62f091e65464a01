"""Configurations that mean nothing are refused, and the message names the class, the field and the value."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import pytest

from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_robust import RobustConfig
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.mixture import MixtureMCL
from dsom_jax.filters.settings import DRAWN, REAL, Settings
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.motion import OdometryMotion, OmniMotion
from dsom_jax.nn import DSOMConfig, PFNetConfig, PFRNNConfig
from dsom_jax.nn.local_view import ViewConfig
from dsom_jax.proposals.dual_features import DualFeaturesConfig
from dsom_jax.proposals.hybrid import HybridConfig
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig
from dsom_jax.proposals.markov_network import MarkovNetworkConfig
from dsom_jax.raycast import RaycastConfig
from dsom_jax.sensor import BeamModel, LikelihoodField, ScoreModel
from dsom_jax.simulate.drive import DriveConfig
from dsom_jax.simulate.worlds import WorldConfig
from dsom_jax.training.batches import ScanConfig, random_noise
from dsom_jax.training.filter_loop import FilterTrainConfig
from dsom_jax.training.loop import StageConfig, TrainConfig
from dsom_jax.training.sequences import SequenceConfig

NAN, INF = math.nan, math.inf
FILTER = {"world": None, "config": None}
SHARED = FILTER | {"proposal": None}
# class: fields that it needs, and what each field may not be
WRONG: dict[type, tuple[dict, dict]] = {
    LidarConfig: ({}, {
        "beams": (0, 2.5), "angle_min": (NAN, 180.0), "angle_increment": (INF, 1.0), "range_min": (-0.1, 10.0, NAN),
        "range_max": (0.0, INF, NAN), "mount": ((0.0, 0.0), (0.0, NAN, 0.0)),
    }),
    LidarNoise: ({}, {"sigma": (-0.1, NAN), "sigma_relative": (-1.0,), "dropout": (1.5, -0.1), "short": (2.0, NAN)}),
    RaycastConfig: ({}, {
        "method": ("fast",), "angles": (3,), "max_skip": (0, 256), "wedges": (-1, 1.5), "surface": (-1.0, NAN),
        "viewpoints": (0, 1.5),
    }),
    ScoreModel: ({}, {
        "sigma": (0.0, NAN), "alpha": (-0.1,), "beta": (-0.1,), "range_max": (0.0, INF), "power": (0, 1.5),
    }),
    BeamModel: ({}, {
        "z_hit": (1.7, NAN), "z_short": (-0.15, 0.16), "sigma_hit": (0.0, NAN), "temper": (0.0,), "range_max": (-1.0,),
    }),
    LikelihoodField: ({}, {
        "z_hit": (0.95,), "z_rand": (-0.1,), "sigma_hit": (0.0,), "max_distance": (0.0, INF), "temper": (-1.0,),
        "range_max": (NAN,),
    }),
    OdometryMotion: ({}, {
        "alpha1": (-0.1,), "alpha4": (NAN,), "min_xy": (-1.0,), "slip": (1.0, -0.1), "tail": (1.0,),
        "tail_scale": (0.0,),
    }),
    OmniMotion: ({}, {"alpha1": (NAN,), "alpha5": (-0.1,), "min_xy": (-1.0,), "min_theta": (INF,)}),
    FilterConfig: ({}, {
        "particles": (0, -5, 1.5), "predecessor": ("nearest",), "resampling": ("none",), "weight_power": (0.0, NAN),
        "estimate_power": (0.0, NAN),
    }),
    MCL: (FILTER, {"injection": (-0.1, 1.1, NAN)}),
    MixtureMCL: (SHARED, {"p": (-0.1, 1.1, NAN)}),
    AdamMCL: (SHARED, {"t_cut": (-0.1, 7, NAN)}),
    RobustConfig: ({}, {
        "particles": (0,), "kidnap": (0.0, 1.0, NAN), "low_min": (0.0, 0.6), "low_max": (1.0,), "flatten": (1.0, -0.1),
        "caution": (1.0,),
    }),
    Settings: ({}, {
        "particles": (0,), "max_beams": (0,), "seed": (-1,), "t_cut": (1.1,), "sharpness": (0.0, NAN),
        "robust_sharpness": (0.0, NAN),
    }),
    LikelihoodGridConfig: ({}, {
        "resolution": (0.0, NAN), "headings": (0,), "angles_per_heading": (0,), "beams": (0,),
    }),
    MarkovNetworkConfig: ({}, {"power": (0.0, NAN), "temper": (-0.1, NAN), "floor": (0.0, 1.0)}),
    HybridConfig: ({}, {"evidence": (-1.0, NAN), "network": (-0.1,), "floor": (0.0, 1.0)}),
    DualFeaturesConfig: ({}, {
        "samples": (0, 9), "layouts": (0,), "obstacles": (-1,), "bandwidth": (0.0, NAN), "headings": (0,),
    }),
    DSOMConfig: ({}, {
        "width": (0,), "headings": (0, 5), "channels": (0,), "resolution": (0.0, NAN), "encoder": ("big",),
        "range_max": (-1.0,), "radial_bins": (1,), "fov_min": (0.0,), "reach_min": (NAN,),
    }),
    WorldConfig: ({}, {
        "cells": (31,), "resolution": (0.0, 0.6, NAN), "room_size": ((6.0, 2.2), (2.2,), (2.2, NAN)),
        "door_width": ((-1.0, 1.0),), "corridors": ((0.5, 0.5), (0.5, 0.5, 0.5, 0.5)), "hall": (1.5,), "void": (NAN,),
        "shelves": (-0.1,),
    }),
    DriveConfig: ({}, {
        "updates": ((), (1,)), "update_min_d": (0.0, NAN), "update_min_a": (-1.0,), "kidnap_distance": (-1.0,),
        "obstacles": (-1,), "removed": (-1,), "near": (NAN,), "margin": (-0.1,),
    }),
    ScanConfig: ({}, {
        "beams": (0,), "range_max": (0.0, 4.0), "reach_min": (0.0, 11.0), "fov_min": (0.0, 7.0), "limited": (1.1,),
        "thinning": (0,), "sigma": (-0.1,), "dropout": (NAN,), "short": (2.0,), "obstacles": ((40, 0), (-1, 3), (5,)),
        "depth": ((0.3, -0.1),), "deep": (-1.0,), "bare": (1.5,),
    }),
    StageConfig: ({}, {"cells": (0, 12), "worlds": (0,), "scans": (-1,)}),
    TrainConfig: ({}, {
        "maps_share": (1.1,), "late_share": (-0.1,), "learning_rate": (0.0, -1e-3, NAN, INF), "warmup": (-1,),
        "clip": (0.0,), "blur": (0.0,), "similarity_weight": (-1.0,), "ema": (1.0, NAN), "seed": (-1,),
    }),
    ViewConfig: ({}, {
        "cells": (0, 12, NAN), "resolution": (0.0, NAN), "map_resolution": (-1.0,), "beams": (0,), "fov_min": (0.0,),
        "reach_min": (INF,),
    }),
    PFNetConfig: ({}, {
        "width": (0,), "features": (0,), "alpha": (0.0, 1.5), "min_xy": (-0.1,), "min_theta": (NAN,),
    }),
    PFRNNConfig: ({}, {"hidden": (0, 1.5), "alpha": (0.0, NAN), "step_xy": (0.0,), "step_theta": (-1.0,)}),
    SequenceConfig: ({}, {
        "beam_step": (0,), "drives": (0,), "window": (1, 141), "obstacles": (-1,), "removed": (0.5,), "noise": (-0.1,),
        "dropout": (1.5,), "short": (NAN,),
    }),
    FilterTrainConfig: ({}, {
        "batch": (0,), "particles": (0,), "start_xy": ((2.0, 1.0), (-1.0, 1.0)), "start_theta": ((1.0,),),
        "strays": (1.0, NAN), "heading_weight": (-1.0,), "particle_xy": (0.0,), "learning_rate": (0.0,),
        "warmup": (-1,), "ema": (1.0,), "seed": (-1,),
    }),
}  # fmt: skip
CASES = [
    (kind, name, value) for kind, (_, fields) in WRONG.items() for name, values in fields.items() for value in values
]


@pytest.mark.parametrize(
    ("kind", "name", "value"), CASES, ids=[f"{kind.__name__}.{name}={value}" for kind, name, value in CASES]
)
def test_what_means_nothing_is_refused(kind, name, value):
    with pytest.raises(ValueError) as refused:
        kind(**WRONG[kind][0], **{name: value})
    message = str(refused.value)
    assert name in message and "\n" not in message
    shown = [str(value), f"{value:g}"] if isinstance(value, float) else [str(value)]
    assert "must be 1" in message or any(text in message for text in shown)


@pytest.mark.parametrize("kind", WRONG)
def test_defaults_are_sound_and_hashable(kind):
    made = kind(**WRONG[kind][0])
    assert kind in (MCL, MixtureMCL, AdamMCL) or hash(made) == hash(kind(**WRONG[kind][0]))


def test_the_settings_of_localize_are_sound():
    for settings in (REAL, DRAWN):
        assert dataclasses.replace(settings) == settings


def test_traced_numbers_are_passed_over():
    noise = jax.jit(lambda key: random_noise(key, ScanConfig()).sigma)(jax.random.key(0))
    assert 0 <= float(noise) <= ScanConfig().sigma
    assert LidarNoise(jnp.float32(-1.0)).sigma == -1  # on the device: not looked at
