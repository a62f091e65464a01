"""A ROS 2 node in place of nav2_amcl: ``python -m dsom_jax.ros2``; only :mod:`dsom_jax.ros2.node` needs ROS."""
