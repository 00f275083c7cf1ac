"""What bodies carried in a window is kept with it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add a column, which is empty in windows of earlier versions."""
    op.add_column("windows", sa.Column("loads", sa.Text(), nullable=True))


def downgrade() -> None:
    """Take it away again."""
    op.drop_column("windows", "loads")
