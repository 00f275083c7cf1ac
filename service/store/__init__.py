"""The history of a fleet, behind SQLAlchemy Core: embedded SQLite by default, any dialect with upserts."""

from sprung.service.store.engine import Store, open_store

__all__ = ["Store", "open_store"]
