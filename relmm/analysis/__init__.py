"""What a robot did and whether its beliefs were right: statistics and pictures of collected grasps, offline."""

from relmm.analysis.collection import Collection, collect
from relmm.analysis.comparison import compare
from relmm.analysis.report import write_report
from relmm.analysis.selection import export, select
from relmm.analysis.summary import summarize_collection

__all__ = ["Collection", "collect", "compare", "export", "select", "summarize_collection", "write_report"]
