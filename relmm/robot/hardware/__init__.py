"""The real LoCoBot without ROS: a Kobuki base, a WidowX-200 arm and a RealSense D435 under `relmm.robot.body.Body`."""
