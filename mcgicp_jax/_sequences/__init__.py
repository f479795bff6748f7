"""Uses of many registrations: odometry, loop closure, multiway registration."""
