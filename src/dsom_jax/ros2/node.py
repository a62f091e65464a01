"""The node: lifecycle, topics, services and parameters of nav2_amcl around :class:`dsom_jax.ros2.engine.Engine`.

The only module that imports ROS. What is missing on a machine is left out (particle_cloud as PoseArray, no
set_initial_pose, no diagnostics, no bond) and said once.
"""

from __future__ import annotations

import threading
import time
from importlib import import_module
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Pose, PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty
from tf2_msgs.msg import TFMessage

from dsom_jax.data.tf_tree import stamp_of
from dsom_jax.errors import UserError
from dsom_jax.live import Answer
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.ros2 import messages
from dsom_jax.ros2.engine import Engine
from dsom_jax.ros2.exchange import Output
from dsom_jax.ros2.parameters import NAMES, Parameters, changed, understood

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
_HEARTBEAT, _HEARTBEAT_TIMEOUT = 0.1, 4.0
"""Seconds, of the bond with nav2's lifecycle manager."""
_LEVELS = {"localized": b"\0", "ambiguous": b"\1"}
"""Of diagnostics: OK and WARN; whatever else is ERROR."""


def optional(name: str, kind: str) -> Any:
    """A message or service type, ``nav2_msgs/msg``, ``ParticleCloud``; None where it is not installed."""
    try:
        return getattr(import_module(name.replace("/", ".")), kind)
    except (ImportError, AttributeError):
        return None


class Amcl(LifecycleNode):
    """nav2_amcl's interface."""

    def __init__(self, name: str = "amcl", grid: OccupancyGrid | None = None, autostart: bool = False) -> None:
        super().__init__(name, allow_undeclared_parameters=True, automatically_declare_parameters_from_overrides=True)
        given = {key: parameter.value for key, parameter in self.get_parameters_by_prefix("").items()}
        parameters, told = understood(given)
        for line in told:
            self.get_logger().info(line)
        for ros_name, field in NAMES.items():
            if not self.has_parameter(ros_name):
                self.declare_parameter(ros_name, getattr(parameters, field))
        self.engine = Engine(parameters, self._say)
        self.add_on_set_parameters_callback(self._set_parameters)
        self._worker: threading.Thread | None = None
        self._from_file, self._bonded = grid is not None, False
        if grid is not None:
            self.engine.hear_map(grid)
        self._declared = [
            self.create_subscription(PoseWithCovarianceStamped, "initialpose", self._initial_pose, 10),
        ]
        if autostart or parameters.autostart:
            self.trigger_configure()
            self.trigger_activate()

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publishers, subscriptions, services. Nothing is compiled yet: a lifecycle manager waits for five seconds."""
        p = self.engine.parameters
        self._make_publishers(p)
        tf_depth = QoSProfile(depth=100)
        fixed = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._declared += [
            self.create_subscription(TFMessage, "/tf", lambda m: self.engine.hear_transforms(m, False), tf_depth),
            self.create_subscription(TFMessage, "/tf_static", lambda m: self.engine.hear_transforms(m, True), fixed),
            self.create_subscription(
                LaserScan, p.scan_topic, lambda m: self.engine.hear_scan(messages.scan_of(m)), qos_profile_sensor_data
            ),
        ]
        if not self._from_file:
            self._declared.append(self.create_subscription(OccupancyGridMessage, p.map_topic, self._map, LATCHED))
        self.create_service(Empty, "reinitialize_global_localization", self._look_everywhere)
        self.create_service(Empty, "request_nomotion_update", self._use_next)
        set_initial_pose = optional("nav2_msgs/srv", "SetInitialPose")
        if set_initial_pose:
            self.create_service(set_initial_pose, "set_initial_pose", self._set_initial_pose)
        else:
            self._say("info", "nav2_msgs is missing: no set_initial_pose, particle_cloud is a PoseArray")
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._diagnose, clock=steady)
        if self._bond:
            self.create_timer(_HEARTBEAT, self._beat_while_active, clock=steady)
        if self._worker is None:
            self._worker = threading.Thread(target=self._work, name="localizer", daemon=True)
            self._worker.start()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Scans are answered from now on."""
        self._bonded = True
        self.engine.activate()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """No more answers; the filter keeps where it is."""
        self.engine.deactivate()
        self._bonded = False
        self._beat()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As before the configuration, but for what was compiled and where the robot was."""
        self._tear_down()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The end."""
        self.engine.deactivate()
        self.close()
        return super().on_shutdown(state)

    def close(self) -> None:
        """End the worker."""
        self.engine.stop()
        if self._worker is not None and self._worker is not threading.current_thread():
            self._worker.join(timeout=2.0)

    def _tear_down(self) -> None:
        keep = self._declared[0]
        for subscription in self._declared[1:]:
            self.destroy_subscription(subscription)
        self._declared = [keep]
        own = ("reinitialize_global_localization", "request_nomotion_update", "set_initial_pose")
        for service in list(self.services):
            if service.srv_name.rsplit("/", 1)[-1] in own:
                self.destroy_service(service)
        for timer in list(self.timers):
            self.destroy_timer(timer)
        for publisher in self._publishers_made:
            self.destroy_publisher(publisher)

    def _make_publishers(self, p: Parameters) -> None:
        cloud = optional("nav2_msgs/msg", "ParticleCloud")
        self._cloud_kind, self._particle = cloud or PoseArray, optional("nav2_msgs/msg", "Particle")
        diagnostics = optional("diagnostic_msgs/msg", "DiagnosticArray")
        status = optional("bond/msg", "Status")
        self._pose_out = self.create_publisher(PoseWithCovarianceStamped, "amcl_pose", LATCHED)
        self._tf_out = self.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._cloud_out = self.create_publisher(self._cloud_kind, "particle_cloud", qos_profile_sensor_data)
        self._places_out = self.create_publisher(PoseArray, "hypotheses", LATCHED)
        self._diagnostics = self.create_publisher(diagnostics, "/diagnostics", 10) if diagnostics else None
        self._bond = self.create_publisher(status, "bond", 10) if status else None
        self._publishers_made = [
            publisher
            for publisher in (self._pose_out, self._tf_out, self._cloud_out, self._places_out, self._diagnostics,
                              self._bond)
            if publisher is not None
        ]  # fmt: skip
        self._cloud_message: Any = None
        self._cloud_due = 0.0
        self._last: Answer | None = None
        self._beams = 0

    # What comes in

    def _map(self, message: Any) -> None:
        try:
            self.engine.hear_map(messages.grid_of(message))
        except UserError as error:
            self._say("error", str(error))

    def _initial_pose(self, message: Any) -> None:
        frame = message.header.frame_id.lstrip("/")
        wanted = self.engine.parameters.global_frame_id
        if frame and frame != wanted.lstrip("/"):
            self._say("warn", f"initial pose in frame {frame} is left out: give it in {wanted}")
            return
        try:
            pose, covariance = messages.pose_of(message.pose)
        except UserError as error:
            self._say("warn", str(error))
            return
        self.engine.hear_pose(pose, covariance, stamp_of(message))

    def _set_initial_pose(self, request: Any, response: Any) -> Any:
        self._initial_pose(request.pose)
        return response

    def _look_everywhere(self, request: Any, response: Any) -> Any:
        self.engine.look_everywhere()
        return response

    def _use_next(self, request: Any, response: Any) -> Any:
        self.engine.use_next()
        return response

    def _set_parameters(self, wanted: list[Any]) -> SetParametersResult:
        parameters = self.engine.parameters
        for parameter in wanted:
            parameters, why = changed(parameters, parameter.name, parameter.value)
            if why:
                return SetParametersResult(successful=False, reason=why)
        self.engine.parameters = parameters
        return SetParametersResult(successful=True)

    # What goes out

    def _work(self) -> None:
        try:
            self.engine.run(self._publish)
        except Exception as error:  # the node must not look alive without its worker
            if rclpy.ok():
                self.get_logger().fatal(f"the filter failed: {type(error).__name__}: {error}")
                rclpy.shutdown()

    def _publish(self, output: Output) -> None:
        """Everything that one answer leads to; called by the worker."""
        p, answer = self.engine.parameters, output.answer
        self._last, self._beams = answer, output.beams
        if p.tf_broadcast and output.map_to_odom is not None:
            transform = TransformStamped()
            at = answer.stamp + p.transform_tolerance
            messages.set_transform(transform, p.global_frame_id, p.odom_frame_id, output.map_to_odom, at)
            self._tf_out.publish(TFMessage(transforms=[transform]))
        if not answer.updated:
            return
        pose = PoseWithCovarianceStamped()
        self._head(pose.header, answer)
        messages.set_pose(pose.pose.pose, answer.pose)
        pose.pose.covariance = messages.covariance36(answer.covariance)
        self._pose_out.publish(pose)
        self._publish_places(answer)
        if time.monotonic() >= self._cloud_due and p.cloud_rate > 0 and self._cloud_out.get_subscription_count():
            self._cloud_due = time.monotonic() + 1 / p.cloud_rate
            self._publish_cloud(answer)

    def _head(self, header: Any, answer: Answer) -> None:
        messages.set_stamp(header.stamp, answer.stamp)
        header.frame_id = self.engine.parameters.global_frame_id

    def _publish_places(self, answer: Answer) -> None:
        """The hypotheses, heaviest first."""
        message = PoseArray(poses=[Pose() for _ in answer.hypotheses])
        self._head(message.header, answer)
        for pose, place in zip(message.poses, answer.hypotheses, strict=True):
            messages.set_pose(pose, place.pose)
        self._places_out.publish(message)

    def _publish_cloud(self, answer: Answer) -> None:
        """The particles; their messages are made once, as that takes longer than an update."""
        poses, weights = self.engine.localizer.particles()
        if self._cloud_message is None:
            self._cloud_message = self._cloud_kind()
            if self._cloud_kind is PoseArray:
                self._cloud_message.poses = [Pose() for _ in poses]
            else:
                self._cloud_message.particles = [self._particle() for _ in poses]
        message = self._cloud_message
        self._head(message.header, answer)
        if self._cloud_kind is PoseArray:
            for pose, place in zip(message.poses, poses, strict=True):
                messages.set_pose(pose, place)
        else:
            for particle, place, weight in zip(message.particles, poses, weights, strict=True):
                messages.set_pose(particle.pose, place)
                particle.weight = float(weight)
        self._cloud_out.publish(message)

    def _diagnose(self) -> None:
        """Verdict, probability of being lost, latency, beams and what became of the scans, once a second."""
        if self._diagnostics is None:
            return
        status_kind = optional("diagnostic_msgs/msg", "DiagnosticStatus")
        value_kind = optional("diagnostic_msgs/msg", "KeyValue")
        counts, answer = self.engine.counts, self._last
        verdict = answer.verdict if answer else "no scan answered yet"
        values: dict[str, Any] = {"verdict": verdict, "p_lost": f"{answer.p_lost if answer else 1.0:.4f}"}
        values |= {"beams": self._beams, "hypotheses": len(answer.hypotheses) if answer else 0}
        latencies = np.array(counts.latencies or [np.nan])
        values |= {"latency_median_ms": f"{1e3 * np.median(latencies):.1f}",
                   "latency_max_ms": f"{1e3 * latencies.max():.1f}"}  # fmt: skip
        values |= {"scans_received": counts.received, "scans_answered": counts.answered,
                   "scans_dropped": counts.dropped, "updates": counts.updated}  # fmt: skip
        name, level = f"{self.get_name()}: localization", _LEVELS.get(verdict, b"\2")
        status = status_kind(level=level, name=name, message=verdict)
        status.values = [value_kind(key=key, value=str(value)) for key, value in values.items()]
        message = self._diagnostics.msg_type(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _beat_while_active(self) -> None:
        if self._bonded:
            self._beat()

    def _beat(self) -> None:
        """A heartbeat of the bond that nav2's lifecycle manager waits for, the last one when it breaks."""
        if self._bond is None:
            return
        own = {"id": self.get_name(), "instance_id": f"{self.get_name()}-{id(self)}"}
        message = self._bond.msg_type(**own, active=self._bonded)
        message.heartbeat_timeout, message.heartbeat_period = _HEARTBEAT_TIMEOUT, _HEARTBEAT
        message.header.stamp = self.get_clock().now().to_msg()
        self._bond.publish(message)

    def _say(self, level: str, text: str) -> None:
        """Log; called by any thread. rclpy tells calls apart by their line, so each level has its own."""
        if level == "info":
            self.get_logger().info(text)
        elif level == "warn":
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)


def spin(arguments: list[str], name: str, grid: OccupancyGrid | None, autostart: bool) -> None:
    """Run the node until it is interrupted."""
    rclpy.init(args=arguments)
    node = None
    try:
        node = Amcl(name, grid, autostart)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
        if rclpy.ok():
            rclpy.shutdown()
