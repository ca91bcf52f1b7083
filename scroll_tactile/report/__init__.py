"""Pages that show what a memory knows, or what a recording holds: one HTML file each."""

from scroll_tactile.report.memory_page import memory_page
from scroll_tactile.report.page import save
from scroll_tactile.report.recording_page import recording_page

__all__ = ["memory_page", "recording_page", "save"]
