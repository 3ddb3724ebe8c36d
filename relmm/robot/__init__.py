"""What the LoCoBot does, written once over a small `Body` interface: skills, judgement, avoidance, safety."""
