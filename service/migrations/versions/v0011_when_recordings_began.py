"""When a recording began is kept where its sender has said it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add a column, which is empty in recordings of earlier versions."""
    op.add_column("recordings", sa.Column("began_ns", sa.BigInteger(), nullable=True))


def downgrade() -> None:
    """Take it away again."""
    op.drop_column("recordings", "began_ns")
