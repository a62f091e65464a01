"""Parameters: a file of nav2 is taken as it is, and what it means here."""

from __future__ import annotations

from dataclasses import fields

import pytest
import yaml

from dsom_jax.errors import UserError
from dsom_jax.filters.settings import DRAWN, REAL
from dsom_jax.motion import OmniMotion, omni_like
from dsom_jax.ros2 import parameters as p

NAV2 = {
    "use_sim_time": True, "alpha1": 0.2, "alpha2": 0.2, "alpha3": 0.2, "alpha4": 0.2, "alpha5": 0.2,
    "base_frame_id": "base_footprint", "beam_skip_distance": 0.5, "beam_skip_error_threshold": 0.9,
    "beam_skip_threshold": 0.3, "do_beamskip": False, "global_frame_id": "map", "lambda_short": 0.1,
    "laser_likelihood_max_dist": 2.0, "laser_max_range": 100.0, "laser_min_range": -1.0,
    "laser_model_type": "likelihood_field", "max_beams": 60, "max_particles": 2000, "min_particles": 500,
    "odom_frame_id": "odom", "pf_err": 0.05, "pf_z": 0.99, "recovery_alpha_fast": 0.0, "recovery_alpha_slow": 0.0,
    "resample_interval": 1, "robot_model_type": "nav2_amcl::DifferentialMotionModel", "save_pose_rate": 0.5,
    "sigma_hit": 0.2, "tf_broadcast": True, "transform_tolerance": 1.0, "update_min_a": 0.2, "update_min_d": 0.25,
    "z_hit": 0.5, "z_max": 0.05, "z_rand": 0.5, "z_short": 0.05, "scan_topic": "scan",
}  # fmt: skip
"""Section ``amcl`` of nav2_bringup's example file."""


def written(tmp_path, **sections):
    path = tmp_path / "nav2_params.yaml"
    path.write_text(yaml.safe_dump({name: {"ros__parameters": values} for name, values in sections.items()}))
    return path


def test_the_example_file_of_nav2_changes_nothing_but_speaks_once(tmp_path):
    values = p.read_file(written(tmp_path, amcl=NAV2, controller_server={"use_sim_time": True}))
    assert values == NAV2
    parameters, told = p.understood(values)
    assert parameters == p.Parameters()
    assert p.settings_of(parameters) == REAL
    (meaningless,) = (line for line in told if "without meaning" in line)
    names = set(meaningless.split(": ")[1].split(", "))
    assert names == set(NAV2) - set(p.NAMES) - {"use_sim_time"}
    assert not [line for line in told if "not known" in line] and any("500 particles" in line for line in told)


def test_names_of_ros_are_those_of_nav2():
    assert {"initial_pose.x", "initial_pose.yaw", "update_min_d", "set_initial_pose"} <= set(p.NAMES)
    assert len(p.NAMES) == len(fields(p.Parameters))
    assert not set(p.NAMES) & p.WITHOUT_MEANING and set(p.LIVE) <= set(p.NAMES)


def test_what_the_user_chose_is_honoured(tmp_path):
    chosen = {"alpha1": 0.05, "alpha2": 0.2, "max_beams": 90, "min_particles": 300, "max_particles": 250,
              "initial_pose": {"x": 1, "yaw": 0.5}, "set_initial_pose": True, "laser_max_range": 12}  # fmt: skip
    everyone = {"update_min_d": 0.5, "max_beams": 10}
    parameters, told = p.understood(p.read_file(written(tmp_path, **{"/**": everyone, "amcl": chosen})))
    assert (parameters.initial_pose_x, parameters.initial_pose_yaw, parameters.set_initial_pose) == (1.0, 0.5, True)
    assert parameters.update_min_d == 0.5 and parameters.reach == 12
    settings = p.settings_of(parameters)
    assert (settings.particles, settings.max_beams) == (250, 90)
    assert settings.robust_motion.alpha1 == 0.05 and settings.robust_motion.alpha2 == REAL.robust_motion.alpha2
    assert settings.robust_motion.slip == REAL.robust_motion.slip
    assert [line for line in told if line.startswith("alpha1: taken")]


def test_omnidirectional_drives_and_floor_plans():
    omni, _ = p.understood({"robot_model_type": "nav2_amcl::OmniMotionModel", "alpha5": 0.1})
    motion = p.settings_of(omni).robust_motion
    assert isinstance(motion, OmniMotion) and motion.alpha5 == 0.1 and motion.alpha1 == REAL.robust_motion.alpha1
    alike, _ = p.understood({"robot_model_type": "nav2_amcl::OmniMotionModel"})
    assert p.settings_of(alike).robust_motion == omni_like(REAL.robust_motion)
    drawn, _ = p.understood({"map_kind": "drawn"})
    assert p.settings_of(drawn).robust == DRAWN.robust


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"update_min_d": "far"}, "update_min_d = 'far': must be a number"),
        ({"update_min_d": -0.1}, "must not be negative"),
        ({"transform_tolerance": float("nan")}, "must be finite"),
        ({"tf_broadcast": 1}, "tf_broadcast = 1: must be true or false"),
        ({"max_beams": True}, "must be a whole number"),
        ({"max_beams": 0}, "at least 1"),
        ({"min_particles": 10.5}, "must be a whole number"),
        ({"initial_pose.x": "here"}, r"initial_pose\.x = 'here'"),
        ({"base_frame_id": 3}, "must be a text"),
        ({"map_kind": "photo"}, "scanned or drawn"),
    ],
)
def test_values_that_mean_nothing(values, says):
    with pytest.raises(UserError, match=says):
        p.understood(values)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("bt_navigator:\n  ros__parameters: {}\n", "no section 'amcl'"),
        ("amcl:\n  parameters: {}\n", "holds no ros__parameters"),
        ("amcl: 3\n", "holds no ros__parameters"),
        ("- a\n", "holds no fields"),
    ],
)
def test_files_that_are_none(tmp_path, text, says):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(UserError, match=says):
        p.read_file(tmp_path / "x.yaml")
    with pytest.raises(UserError, match="no such parameter file"):
        p.read_file(tmp_path / "y.yaml")


def test_a_slip_of_the_pen_is_named():
    _, told = p.understood({"update_min_dd": 0.1, "qos_overrides./tf.depth": 3})
    assert [line for line in told if "update_min_dd is not known, did you mean update_min_d?" in line]
    assert not [line for line in told if "qos_overrides" in line]
    _, told = p.understood({"map_file": "map.yaml"})  # the map is the option --map, no parameter
    assert [line for line in told if "map_file is not known" in line]


def test_changes_while_it_runs():
    before = p.Parameters()
    after, why = p.changed(before, "update_min_d", 1)
    assert after.update_min_d == 1.0 and why == ""
    for name, value, says in (
        ("max_beams", 30, "fixed when the filter is compiled"),
        ("base_frame_id", "base", "fixed"),
        ("update_min_d", -1.0, "negative"),
        ("nonsense", 1, "no parameter"),
    ):
        same, why = p.changed(before, name, value)
        assert same == before and says in why
    assert p.changed(before, "use_sim_time", True) == (before, "")
    assert p.changed(before, "z_hit", 0.1) == (before, "")
