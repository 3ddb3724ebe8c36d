"""What LeRobot's plugin discovery imports: it looks for a module named like the distribution."""

import relmm.plugin  # noqa: F401
