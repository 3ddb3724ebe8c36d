"""A package that adds a room to relmm."""
