"""A column of tokens that was never written goes."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Drop the column; it is empty in every store."""
    op.drop_column("tokens", "used_ns")


def downgrade() -> None:
    """Add it again."""
    op.add_column("tokens", sa.Column("used_ns", sa.BigInteger(), nullable=True))
