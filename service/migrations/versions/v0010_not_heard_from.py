"""Vehicles from which no window has come are listed as not monitored; they had been called well."""

from __future__ import annotations

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

UNHEARD = "revision = 0 AND last_window_ns IS NULL AND alarms + warnings + earlier = 0"


def upgrade() -> None:
    """Correct the rows of such vehicles."""
    op.execute(f"UPDATE fleet_status SET health = 'check_function' WHERE health = 'ok' AND {UNHEARD}")


def downgrade() -> None:
    """As it was."""
    op.execute(f"UPDATE fleet_status SET health = 'ok' WHERE health = 'check_function' AND {UNHEARD}")
