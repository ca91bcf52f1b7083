"""Recordings: files of robots, as readings with times and labels.

recording = read("touch.mcap", topic="/rh/tactile", field="tactiles[0].electrodes")
recording.readings, recording.times      # (T, n), (T,) seconds
print(recording.report)                  # rate, jitter, gaps, lost and repeated readings, the clock
print(describe("touch.mcap"))            # what there is to read
"""

from scroll_tactile.recordings.blocks import Contents, Entry
from scroll_tactile.recordings.presets import PRESETS, Preset
from scroll_tactile.recordings.reader import describe, find, iterate, read
from scroll_tactile.recordings.recording import Episode, Gap, Recording, Report, resampled
from scroll_tactile.recordings.touches import Interval, Touch, declared_quantities, read_intervals, touches

__all__ = [
    "PRESETS",
    "Contents",
    "Entry",
    "Episode",
    "Gap",
    "Interval",
    "Preset",
    "Recording",
    "Report",
    "Touch",
    "declared_quantities",
    "describe",
    "find",
    "iterate",
    "read",
    "read_intervals",
    "resampled",
    "touches",
]
