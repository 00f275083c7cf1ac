"""Files of recordings age by the clock of retention, which ignores leaps of the host's."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add a column; recordings of earlier versions go on by the host's clock."""
    op.add_column("recordings", sa.Column("kept_since_ns", sa.BigInteger(), nullable=True))


def downgrade() -> None:
    """Take it away again."""
    op.drop_column("recordings", "kept_since_ns")
