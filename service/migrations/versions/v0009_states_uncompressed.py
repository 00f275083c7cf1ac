"""PostgreSQL stops compressing tracker states: base64 of numbers, on which it spends most of a write for nothing."""

from __future__ import annotations

from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Rows that are there are changed when they are written next."""
    _store("EXTERNAL")


def downgrade() -> None:
    """As it was."""
    _store("EXTENDED")


def _store(how: str) -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute(f"ALTER TABLE tracker_states ALTER COLUMN state SET STORAGE {how}")
