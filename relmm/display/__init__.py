"""What a robot sees, believes and does, to look at while it happens."""

from relmm.display.live_view import LiveView

__all__ = ["LiveView"]
