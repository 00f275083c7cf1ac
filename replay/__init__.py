"""Recordings and live buses as blocks of samples, and blocks of samples as windows.

The doors: `open_recording` (files), `replay.live.LiveBus` (buses), `replay.windowing.Windower` (even windows)
and `replay.record.load_record` (one long even record).
"""

from sprung.replay.account import UnreadableRecording
from sprung.replay.recording import Recording, open_recording

__all__ = ["Recording", "UnreadableRecording", "open_recording"]
