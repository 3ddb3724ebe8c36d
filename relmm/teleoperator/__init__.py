"""`--teleop.type=locobot_scripted`: records with stock `lerobot-record` without a person."""
