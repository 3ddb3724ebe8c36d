"""LeRobot policies that clean a room: scripted and random controllers."""
