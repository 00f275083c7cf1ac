from .account import UnreadableRecording
from .recording import Recording, open_recording

__all__ = ["Recording", "UnreadableRecording", "open_recording"]
