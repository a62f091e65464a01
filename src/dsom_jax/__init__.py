"""Find a lidar robot on a known map: DSOM and AdaM MCL in JAX."""
