"""Room for uploads: what is kept and what is just being received together stay within the quota and the disk."""

from __future__ import annotations

import threading

from sprung.service.condition import free_bytes
from sprung.service.errors import NoSpace
from sprung.service.settings import Settings
from sprung.service.store import Store, work


class UploadRoom:
    """Of the one process that receives uploads.  Safe to share between threads."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self._deciding = threading.Lock()  # held while the store is asked
        self._lock = threading.Lock()  # of the shares, never held for long: the event loop gives back, too
        self._shares: set[Share] = set()

    def share(self) -> Share:
        """The share of an upload that begins, empty yet."""
        return Share(self)

    def take(self, share: Share, count: int) -> None:
        """Add bytes to a share.  Raises NoSpace when so many are not left.

        A share that is refused is given back at once: of several uploads that come in pieces and do not all fit, as
        many are received as do.
        """
        with self._deciding:
            # the shares first: an upload that ends meanwhile counts twice instead of not at all
            with self._lock:
                taken = sum(each.taken for each in self._shares)
                to_come = sum(max(each.taken - each.written, 0) for each in self._shares)
            settings = self._settings
            settings.uploads.mkdir(parents=True, exist_ok=True)
            with self._store.read() as connection:
                kept = work.stored_bytes(connection)
            left = min(
                settings.max_uploads_bytes - kept - taken,
                free_bytes(settings.uploads) - settings.min_free_bytes - to_come,
            )
            if left <= 0 or left < count:
                self.give_back(share)
                raise NoSpace(
                    f"no room for this upload: {max(left, 0) / 1e6:.0f} MB are left for uploads; try again later"
                )
            with self._lock:
                share.taken += count
                self._shares.add(share)

    def give_back(self, share: Share) -> None:
        """The upload has ended: its file is kept, and counted by the store, or gone."""
        with self._lock:
            self._shares.discard(share)


class Share:
    """Bytes that one upload may take while it is received."""

    def __init__(self, room: UploadRoom) -> None:
        self._room = room
        self.taken = 0
        self.written = 0  # of them, on the disk

    def take(self, count: int) -> None:
        """More of them, before they come.  Raises NoSpace."""
        self._room.take(self, count)

    def reach(self, count: int) -> None:
        """Take what is missing for so many in all.  Raises NoSpace."""
        if count > self.taken:
            self.take(count - self.taken)

    def give_back(self) -> None:
        """The end of the upload, also when nothing was taken."""
        self._room.give_back(self)
