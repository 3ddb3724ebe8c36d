"""The simulated LoCoBot: its MuJoCo body, rooms, cameras, and the gymnasium environment for evaluation."""
