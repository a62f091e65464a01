"""What explains a log and a map: scans against themselves, against the odometry, and against the map."""
