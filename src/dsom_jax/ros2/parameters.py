"""The parameters of nav2_amcl, as this filter understands them; a parameter file of nav2 is taken as it is."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from dsom_jax.data.documents import read_yaml
from dsom_jax.errors import UserError
from dsom_jax.filters.settings import DRAWN, REAL, Settings
from dsom_jax.motion import OdometryMotion, omni_like

_REACH = 25.0
"""Metres: nav2's ``laser_max_range`` of 100 means no limit, where this filter's grid would be too coarse."""
_ALPHA = 0.2
"""nav2's default of ``alpha1`` to ``alpha5``, which every example file spells out."""


@dataclass(frozen=True)
class Parameters:
    """Fields are named and preset as in nav2_amcl; ``initial_pose.x`` is ``initial_pose_x``. The last four are new.

    Attributes:
        base_frame_id, odom_frame_id, global_frame_id: frames, with whatever prefix.
        scan_topic, map_topic: topics; relative to the node's namespace.
        transform_tolerance: seconds by which map -> odom is post-dated.
        tf_broadcast: whether it is sent.
        first_map_only: keep the first map of the topic.
        update_min_d, update_min_a: metres and radians between updates.
        laser_max_range, laser_min_range: metres; negative leaves what the scans say.
        max_beams: beams used for weighing.
        min_particles: the number of particles, which is fixed here.
        max_particles: read for its sake: never more.
        alpha1, alpha2, alpha3, alpha4, alpha5: noise of the odometry; nav2's default leaves the filter's own.
        random_seed: negative takes the time.
        robot_model_type: anything with ``omni`` in it is an omnidirectional drive.
        set_initial_pose: start from ``initial_pose_*``; else the filter finds the robot without.
        initial_pose_x, initial_pose_y, initial_pose_z, initial_pose_yaw: map frame.
        always_reset_initial_pose: forget the last pose when activated again.
        save_pose_rate: times a second that the pose is saved to ``saved_pose_filepath``.
        initialize_at_saved_pose: start from the pose saved there.
        saved_pose_filepath: JSON file; nothing is saved without one.
        autostart: configure and activate without a lifecycle manager.
        map_kind: ``scanned``, or ``drawn`` for a floor plan without furniture.
        publish_while_lost: go on sending the last map -> odom that was trusted.
        cloud_rate: times a second that ``particle_cloud`` is published.
    """

    base_frame_id: str = "base_footprint"
    odom_frame_id: str = "odom"
    global_frame_id: str = "map"
    scan_topic: str = "scan"
    map_topic: str = "map"
    transform_tolerance: float = 1.0
    tf_broadcast: bool = True
    first_map_only: bool = False
    update_min_d: float = 0.25
    update_min_a: float = 0.2
    laser_max_range: float = 100.0
    laser_min_range: float = -1.0
    max_beams: int = 60
    min_particles: int = 500
    max_particles: int = 2000
    alpha1: float = _ALPHA
    alpha2: float = _ALPHA
    alpha3: float = _ALPHA
    alpha4: float = _ALPHA
    alpha5: float = _ALPHA
    random_seed: int = -1
    robot_model_type: str = "nav2_amcl::DifferentialMotionModel"
    set_initial_pose: bool = False
    initial_pose_x: float = 0.0
    initial_pose_y: float = 0.0
    initial_pose_z: float = 0.0
    initial_pose_yaw: float = 0.0
    always_reset_initial_pose: bool = False
    save_pose_rate: float = 0.5
    initialize_at_saved_pose: bool = False
    saved_pose_filepath: str = ""
    autostart: bool = False
    map_kind: str = "scanned"
    publish_while_lost: bool = True
    cloud_rate: float = 2.0

    @property
    def reach(self) -> float:
        """Greatest range used, metres."""
        return min(self.laser_max_range, _REACH) if self.laser_max_range > 0 else _REACH


LIVE = ("update_min_d", "update_min_a", "transform_tolerance", "tf_broadcast", "first_map_only", "publish_while_lost",
        "cloud_rate")  # fmt: skip
"""What may be changed while the node runs."""
WITHOUT_MEANING = {
    "laser_model_type", "lambda_short", "laser_likelihood_max_dist", "do_beamskip", "beam_skip_distance",
    "beam_skip_threshold", "beam_skip_error_threshold", "pf_err", "pf_z", "resample_interval", "recovery_alpha_slow",
    "recovery_alpha_fast", "freespace_downsampling", "allow_parameter_qos_overrides", "introspection_mode",
    "service_introspection_mode", "z_hit", "z_short", "z_max", "z_rand", "sigma_hit",
}  # fmt: skip
"""Parameters of nav2_amcl that say nothing to this filter: it has a sensor model of its own, draws anew by what the
scans say, and resamples at every update."""
OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides", "bond_heartbeat_period")
"""Known to ROS itself or to nav2's base class, and not reported."""
NAMES = {name.replace("initial_pose_", "initial_pose."): name for name in (f.name for f in fields(Parameters))}
"""Name in ROS -> field."""
_KIND: dict[str, Any] = {f.name: type(f.default) for f in fields(Parameters)}
_POSITIVE = ("max_beams", "min_particles", "max_particles")
_NOT_NEGATIVE = ("transform_tolerance", "update_min_d", "update_min_a", "alpha1", "alpha2", "alpha3", "alpha4",
                 "alpha5", "save_pose_rate", "cloud_rate")  # fmt: skip


def read_file(path: str | Path, node: str = "amcl") -> dict[str, Any]:
    """Parameters that a ROS parameter file gives to ``node``, nested names joined by dots; what it says for all first.

    Raises:
        UserError: no such file, no YAML, or nothing in it for the node.
    """
    document = read_yaml(path, "parameter file")
    found: dict[str, Any] = {}
    sections = [name for name in ("/**", node, f"/{node}") if name in document]
    for name in sections:
        section = document[name]
        values = section.get("ros__parameters") if isinstance(section, Mapping) else None
        if not isinstance(values, Mapping):
            raise UserError(f"{path}: section {name} holds no ros__parameters; write them as nav2's files do")
        found |= flattened(values)
    if not sections:
        raise UserError(f"{path}: has no section '{node}' with ros__parameters, only {', '.join(document)}")
    return found


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with names joined by dots."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flattened(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def understood(values: Mapping[str, Any]) -> tuple[Parameters, list[str]]:
    """Parameters of what the user set, by ROS name, and one line for each thing that the user should know.

    Raises:
        UserError: a value of the wrong kind or out of bounds.
    """
    known = {NAMES[name]: _checked(NAMES[name], value) for name, value in values.items() if name in NAMES}
    parameters = replace(Parameters(), **known)
    if parameters.map_kind not in ("scanned", "drawn"):
        raise UserError(f"parameter map_kind = {parameters.map_kind!r}: choose scanned or drawn")
    return parameters, [*_without_meaning(values), *_unknown(values), *_notes(parameters, values)]


def _checked(field: str, value: Any) -> Any:
    """A value of the field's kind; whole numbers do for real ones, as in ROS's files."""
    kind = _KIND[field]
    name = field.replace("initial_pose_", "initial_pose.") if field in NAMES.values() else field
    wrong = isinstance(value, bool) != (kind is bool)
    if kind is float and not wrong and isinstance(value, int | float):
        value = float(value)
    if wrong or not isinstance(value, kind):
        raise UserError(f"parameter {name} = {value!r}: must be {_WORDS[kind]}")
    if kind is float and not math.isfinite(value):
        raise UserError(f"parameter {name} = {value!r}: must be finite")
    if field in _POSITIVE and value < 1:
        raise UserError(f"parameter {name} = {value!r}: must be at least 1")
    if field in _NOT_NEGATIVE and value < 0:
        raise UserError(f"parameter {name} = {value!r}: must not be negative")
    return value


_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}


def _without_meaning(values: Mapping[str, Any]) -> list[str]:
    names = sorted(name for name in values if name in WITHOUT_MEANING)
    return [f"parameters of nav2_amcl without meaning here: {', '.join(names)}"] if names else []


def _unknown(values: Mapping[str, Any]) -> list[str]:
    odd = sorted(n for n in values if n not in NAMES and n not in WITHOUT_MEANING and not n.startswith(OF_ROS))
    return [f"parameter {name} is not known{_meant(name)}; it is left out" for name in odd]


def _meant(name: str) -> str:
    close = difflib.get_close_matches(name, NAMES, 1)
    return f", did you mean {close[0]}?" if close else ""


def _notes(parameters: Parameters, values: Mapping[str, Any]) -> list[str]:
    """What is understood in another way than nav2_amcl does."""
    told = [f"{particles(parameters)} particles at all times (min_particles)"]
    if parameters.laser_max_range > _REACH and "laser_max_range" in values:
        told.append(f"laser_max_range {parameters.laser_max_range:g} is taken as {_REACH:g} m")
    own = [name for name in sorted(values) if name.startswith("alpha") and values[name] != _ALPHA and name in NAMES]
    if own:
        told.append(f"{', '.join(own)}: taken in place of the filter's own noise, which is smaller with rare slips")
    if parameters.set_initial_pose and parameters.initialize_at_saved_pose:
        told.append("initialize_at_saved_pose: used before initial_pose where the file is there")
    return told


def particles(parameters: Parameters) -> int:
    """The fixed number of particles."""
    return min(parameters.min_particles, parameters.max_particles)


def settings_of(parameters: Parameters) -> Settings:
    """Settings of the filter."""
    kind = DRAWN if parameters.map_kind == "drawn" else REAL
    return replace(
        kind, particles=particles(parameters), max_beams=parameters.max_beams, robust_motion=motion(parameters, kind)
    )


def motion(parameters: Parameters, kind: Settings) -> Any:
    """Model of the drive: the filter's own, but for the alphas that differ from nav2's defaults."""
    own = kind.robust_motion
    assert isinstance(own, OdometryMotion)
    chosen = {name: value for name in _ALPHAS if (value := getattr(parameters, name)) != _ALPHA}
    if "omni" in parameters.robot_model_type.lower():
        return replace(omni_like(own), **chosen)
    chosen.pop("alpha5", None)
    return replace(own, **chosen)


_ALPHAS = ("alpha1", "alpha2", "alpha3", "alpha4", "alpha5")


def changed(parameters: Parameters, name: str, value: Any) -> tuple[Parameters, str]:
    """The parameters after a change at run time, and why it is refused (empty if it is not)."""
    field = NAMES.get(name)
    if field is None:
        known = name.startswith(OF_ROS) or name in WITHOUT_MEANING
        return parameters, "" if known else f"{name} is no parameter of this node"
    if field not in LIVE:
        return parameters, f"{name} is fixed when the filter is compiled; set it in the file and start the node again"
    try:
        return replace(parameters, **{field: _checked(field, value)}), ""
    except UserError as error:
        return parameters, str(error)
