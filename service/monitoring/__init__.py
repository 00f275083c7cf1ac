"""From windows to a vehicle's state: identify, track, store; and what is held in memory for it."""
