"""What the evidence does not tell an alarm from is kept with it; names of many channels that share a fault fit."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

OLD, NEW = sa.String(length=160), sa.String(length=1000)


def upgrade() -> None:
    """Add a column, of which alarms of earlier versions say nothing; make room in another."""
    with op.batch_alter_table("alarms") as table:
        table.add_column(sa.Column("alternatives", sa.JSON(), nullable=True))
        table.alter_column("parameter", existing_type=OLD, type_=NEW, existing_nullable=False)


def downgrade() -> None:
    """Alarms with longer names go: an earlier version could not have stored them."""
    op.execute("DELETE FROM alarms WHERE length(parameter) > 160")
    with op.batch_alter_table("alarms") as table:
        table.drop_column("alternatives")
        table.alter_column("parameter", existing_type=NEW, type_=OLD, existing_nullable=False)
