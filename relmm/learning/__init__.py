"""Learning online: from here on the robot improves by itself."""
