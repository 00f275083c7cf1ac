"""A window and what the tracker believed after it become one row, by month on PostgreSQL; estimates that wait."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from sprung.service.store.partitions import ensure_months

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

SHARED = (
    "vehicle_id, start_ns, model_id, stored_ns, recording_id, outcome, reason, repaired_samples, tracked, nrmse, "
    "chi_square, adequate, converged, iterations, log_ratio, std, identifiable, per_sensor"
)


def upgrade() -> None:
    """Make the new table beside the old one, copy, drop the old one."""
    _set_aside()
    op.create_table(
        "windows",
        *_columns(),
        sa.Column("posterior", sa.LargeBinary(), nullable=True),
        sa.Column("posterior_std", sa.LargeBinary(), nullable=True),
        *_foreign_keys(),
        sa.PrimaryKeyConstraint("vehicle_id", "start_ns", "model_id", name=op.f("pk_windows")),
        postgresql_partition_by="RANGE (start_ns)",
    )
    connection = op.get_bind()
    month_ns = 28 * 86_400 * 10**9  # steps that miss no month
    first, last = connection.execute(sa.text("SELECT min(start_ns), max(start_ns) FROM windows_old")).one()
    if first is not None:
        ensure_months(connection, [*range(first, last, month_ns), last])
    op.execute(
        f"INSERT INTO windows ({SHARED}, posterior, posterior_std) "
        f"SELECT {', '.join('w.' + name for name in SHARED.split(', '))}, p.log_ratio, p.std "
        "FROM windows_old AS w LEFT JOIN posteriors AS p ON p.window_id = w.id"
    )
    op.drop_table("posteriors")
    op.drop_table("windows_old")
    op.create_index("ix_windows_stored_ns", "windows", ["stored_ns"], unique=False)
    op.create_table(
        "pending",
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("model_id", sa.Integer(), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("received_ns", sa.BigInteger(), nullable=False),
        sa.Column("message", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_pending_model_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_pending_vehicle_id")),
        sa.PrimaryKeyConstraint("vehicle_id", "model_id", "start_ns", name=op.f("pk_pending")),
    )
    op.create_index("ix_pending_received_ns", "pending", ["received_ns"], unique=False)


def downgrade() -> None:
    """Two tables again."""
    op.drop_index("ix_pending_received_ns", table_name="pending")
    op.drop_table("pending")
    _set_aside()
    op.create_table(
        "windows",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        *_columns(),
        *_foreign_keys(),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_windows")),
        sa.UniqueConstraint("vehicle_id", "start_ns", "model_id", name=op.f("uq_windows_vehicle_id_start_ns_model_id")),
    )
    op.create_table(
        "posteriors",
        sa.Column("window_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("log_ratio", sa.LargeBinary(), nullable=False),
        sa.Column("std", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["window_id"], ["windows.id"], name=op.f("fk_posteriors_window_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("window_id", name=op.f("pk_posteriors")),
    )
    op.execute(f"INSERT INTO windows ({SHARED}) SELECT {SHARED} FROM windows_old")
    op.execute(
        "INSERT INTO posteriors (window_id, log_ratio, std) SELECT w.id, o.posterior, o.posterior_std "
        "FROM windows_old AS o JOIN windows AS w ON w.vehicle_id = o.vehicle_id AND w.start_ns = o.start_ns "
        "AND w.model_id = o.model_id WHERE o.posterior IS NOT NULL"
    )
    op.drop_table("windows_old")
    op.create_index("ix_windows_stored_ns", "windows", ["stored_ns"], unique=False)


def _set_aside() -> None:
    """The old table under another name; PostgreSQL's names of indexes are unique among all tables."""
    op.drop_index("ix_windows_stored_ns", table_name="windows")
    op.rename_table("windows", "windows_old")
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER INDEX pk_windows RENAME TO pk_windows_old")


def _columns() -> list[sa.Column[object]]:
    return [
        sa.Column("vehicle_id", sa.String(length=128), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("model_id", sa.Integer(), nullable=False),
        sa.Column("stored_ns", sa.BigInteger(), nullable=False),
        sa.Column("recording_id", sa.String(length=36), nullable=True),
        sa.Column("outcome", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=True),
        sa.Column("repaired_samples", sa.Integer(), nullable=False),
        sa.Column("tracked", sa.Boolean(), nullable=False),
        sa.Column("nrmse", sa.Float(), nullable=True),
        sa.Column("chi_square", sa.Float(), nullable=True),
        sa.Column("adequate", sa.Boolean(), nullable=True),
        sa.Column("converged", sa.Boolean(), nullable=True),
        sa.Column("iterations", sa.Integer(), nullable=True),
        sa.Column("log_ratio", sa.LargeBinary(), nullable=True),
        sa.Column("std", sa.LargeBinary(), nullable=True),
        sa.Column("identifiable", sa.LargeBinary(), nullable=True),
        sa.Column("per_sensor", sa.LargeBinary(), nullable=True),
    ]


def _foreign_keys() -> list[sa.ForeignKeyConstraint]:
    pairs = (("model_id", "models"), ("recording_id", "recordings"), ("vehicle_id", "vehicles"))
    return [
        sa.ForeignKeyConstraint([column], [f"{table}.id"], name=op.f(f"fk_windows_{column}")) for column, table in pairs
    ]
