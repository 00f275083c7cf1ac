"""Recordings and live buses as blocks of samples, and blocks of samples as windows.

Public: `open_recording` (files), `replay.live.LiveBus` (buses), `replay.windowing.Windower` (even windows)
and `replay.record.load_record` (one long even record).  Readers load when they are first used: those of CAN buses and
of MF4 take seconds, which processes that read nothing need not wait for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
