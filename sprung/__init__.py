"""Sprung: condition of a train's springs and dampers from running recordings.

>>> import sprung
>>> system = sprung.load_system()
>>> len(system.parameters)
24

`load_system`, `open_recording`, `load_record`, `identify`, `track`, `diagnose`, `write_report`, `simulate` and `Client`
are what most programs need; their docstrings show them at work.  Names load when they are first used, so that
`import sprung` and `sprung --help` are quick.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
