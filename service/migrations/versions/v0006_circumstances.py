"""How vehicles ran: load, temperature, speed and pressures as means of minutes and hours."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add a table."""
    op.create_table(
        "circumstances",
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("resolution_s", sa.Integer(), nullable=False),
        sa.Column("bucket_ns", sa.BigInteger(), nullable=False),
        sa.Column("means", sa.JSON(), nullable=False),
        sa.Column("updated_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_circumstances_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("vehicle_id", "resolution_s", "bucket_ns", name=op.f("pk_circumstances")),
    )


def downgrade() -> None:
    """Take it away again."""
    op.drop_table("circumstances")
