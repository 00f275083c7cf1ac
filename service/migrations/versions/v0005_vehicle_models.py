"""System files of single vehicles, and which one was in use since when."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Two tables; every vehicle goes on with the service's system file."""
    op.create_table(
        "vehicle_models",
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("model_id", sa.Integer(), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("report_id", sa.String(length=36), nullable=True),
        sa.Column("author", sa.String(length=160), nullable=False),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_vehicle_models_model_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_vehicle_models_vehicle_id")),
        sa.PrimaryKeyConstraint("vehicle_id", "version", name=op.f("pk_vehicle_models")),
    )
    op.create_table(
        "vehicle_model_uses",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("author", sa.String(length=160), nullable=False),
        sa.Column("since_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_vehicle_model_uses_vehicle_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_vehicle_model_uses")),
    )
    op.create_index("ix_vehicle_model_uses_vehicle_id", "vehicle_model_uses", ["vehicle_id"], unique=False)


def downgrade() -> None:
    """Every vehicle falls back to the service's system file."""
    op.drop_index("ix_vehicle_model_uses_vehicle_id", table_name="vehicle_model_uses")
    op.drop_table("vehicle_model_uses")
    op.drop_table("vehicle_models")
