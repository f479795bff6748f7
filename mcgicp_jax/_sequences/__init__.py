"""Uses of many registrations: odometry, relocalisation, loop closure, multiway registration."""
