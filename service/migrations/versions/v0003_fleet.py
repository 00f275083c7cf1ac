"""The fleet's list in one table; what people do: acknowledgements, notes, maintenance; notifications."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the tables and columns; `fleet_status` is filled from the trackers at the next start."""
    op.add_column("vehicles", sa.Column("label", sa.String(length=128), nullable=True))
    op.add_column("vehicles", sa.Column("retired_ns", sa.BigInteger(), nullable=True))
    op.add_column("alarms", sa.Column("acknowledged_ns", sa.BigInteger(), nullable=True))
    op.add_column("alarms", sa.Column("acknowledged_by", sa.String(length=128), nullable=True))
    op.create_index("ix_alarms_opened_ns", "alarms", ["opened_ns"], unique=False)
    if op.get_bind().dialect.name == "postgresql":  # SQLite heeds no lengths, and cannot change them
        op.alter_column("windows", "outcome", type_=sa.String(length=16))
    _fleet_tables()
    op.create_table(
        "marks",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("text", sa.String(length=2000), nullable=False),
        sa.Column("parameters", sa.JSON(), nullable=True),
        sa.Column("author", sa.String(length=128), nullable=False),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_marks_vehicle_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_marks")),
    )
    op.create_index("ix_marks_vehicle_id_time_ns", "marks", ["vehicle_id", "time_ns"], unique=False)
    op.create_table(
        "deliveries",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("kind", sa.String(length=64), nullable=False),
        sa.Column("target", sa.String(length=300), nullable=False),
        sa.Column("event", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("next_ns", sa.BigInteger(), nullable=False),
        sa.Column("error", sa.String(length=300), nullable=True),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.Column("updated_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_deliveries")),
    )
    op.create_index("ix_deliveries_state_next_ns", "deliveries", ["state", "next_ns"], unique=False)
    op.create_table(
        "idempotency",
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("request", sa.String(length=64), nullable=False),
        sa.Column("status", sa.Integer(), nullable=False),
        sa.Column("body", sa.JSON(), nullable=False),
        sa.Column("location", sa.String(length=200), nullable=True),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_idempotency")),
    )


def _fleet_tables() -> None:
    op.create_table(
        "fleet_status",
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("model_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("health", sa.String(length=24), nullable=False),
        sa.Column("urgency", sa.Integer(), nullable=False),
        sa.Column("alarms", sa.Integer(), nullable=False),
        sa.Column("warnings", sa.Integer(), nullable=False),
        sa.Column("unacknowledged", sa.Integer(), nullable=False),
        sa.Column("earlier", sa.Integer(), nullable=False),
        sa.Column("largest", sa.String(length=160), nullable=True),
        sa.Column("drift", sa.Float(), nullable=True),
        sa.Column("drift_std", sa.Float(), nullable=True),
        sa.Column("nrmse", sa.Float(), nullable=True),
        sa.Column("learned", sa.Float(), nullable=False),
        sa.Column("elements", sa.String(length=400), nullable=False),
        sa.Column("last_window_ns", sa.BigInteger(), nullable=True),
        sa.Column("received_ns", sa.BigInteger(), nullable=False),
        sa.Column("used", sa.Integer(), nullable=False),
        sa.Column("repaired", sa.Integer(), nullable=False),
        sa.Column("dropped", sa.Integer(), nullable=False),
        sa.Column("uninformative", sa.Integer(), nullable=False),
        sa.Column("unfitting", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_fleet_status_model_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_fleet_status_vehicle_id")),
        sa.PrimaryKeyConstraint("vehicle_id", name=op.f("pk_fleet_status")),
    )
    op.create_index("ix_fleet_status_urgency_vehicle_id", "fleet_status", ["urgency", "vehicle_id"], unique=False)
    op.create_table(
        "window_reasons",
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("model_id", sa.Integer(), nullable=False),
        sa.Column("outcome", sa.String(length=20), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=False),
        sa.Column("windows", sa.Integer(), nullable=False),
        sa.Column("last_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_window_reasons_model_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_window_reasons_vehicle_id")),
        sa.PrimaryKeyConstraint("vehicle_id", "model_id", "outcome", "reason", name=op.f("pk_window_reasons")),
    )


def downgrade() -> None:
    """Drop what `upgrade` added."""
    for table in ("window_reasons", "idempotency"):
        op.drop_table(table)
    for index, table in (
        ("ix_fleet_status_urgency_vehicle_id", "fleet_status"),
        ("ix_deliveries_state_next_ns", "deliveries"),
        ("ix_marks_vehicle_id_time_ns", "marks"),
    ):
        op.drop_index(index, table_name=table)
        op.drop_table(table)
    op.drop_index("ix_alarms_opened_ns", table_name="alarms")
    for table, column in (
        ("alarms", "acknowledged_by"),
        ("alarms", "acknowledged_ns"),
        ("vehicles", "retired_ns"),
        ("vehicles", "label"),
    ):
        op.drop_column(table, column)
