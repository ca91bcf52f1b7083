"""Pages that show what a memory knows, or what a recording holds: one HTML file each."""

from scroll_tactile.clients.report.memory_page import memory_page
from scroll_tactile.clients.report.page import save
from scroll_tactile.clients.report.recording_page import recording_page

__all__ = ["memory_page", "recording_page", "save"]
