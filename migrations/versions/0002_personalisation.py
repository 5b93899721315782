"""Trials, jobs, versions and their weights."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

INSTANT = sa.DateTime(timezone=True)
JSON = sa.JSON(none_as_null=True)
COUNTED = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def owner(table: str) -> tuple[sa.Column[object], sa.ForeignKeyConstraint]:
    """Hang a table's rows on their user, with whom they go."""
    return (
        sa.Column("user_uuid", sa.Uuid(), nullable=False),
        sa.ForeignKeyConstraint(
            ["user_uuid"], ["users.uuid"], name=f"fk_{table}_user_uuid", ondelete="CASCADE"
        ),
    )


def create_partial_index(name: str, table: str, columns: list[str], where: str) -> None:
    """Let only one row of those that the condition names have the same values."""
    op.create_index(
        name,
        table,
        columns,
        unique=True,
        sqlite_where=sa.text(where),
        postgresql_where=sa.text(where),
    )


def upgrade() -> None:
    extend_users()
    create_trials()
    create_clips()
    create_jobs()
    create_versions()
    create_idempotency()


def extend_users() -> None:
    op.add_column(
        "users", sa.Column("auto_promote", sa.Boolean(), nullable=False, server_default=sa.true())
    )
    op.add_column(
        "users",
        sa.Column("last_version", sa.Integer(), nullable=False, server_default=sa.text("0")),
    )
    op.add_column("users", sa.Column("served_at", INSTANT, nullable=True))


def create_trials() -> None:
    op.create_table(
        "trials",
        sa.Column("id", sa.Uuid(), nullable=False),
        *owner("trials"),
        sa.Column("label", sa.String(200), nullable=True),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("source", sa.String(16), nullable=False),
        sa.Column("finetune", sa.Boolean(), nullable=False),
        sa.Column("session", sa.String(64), nullable=True),
        sa.Column("epoch", sa.BigInteger(), nullable=True),
        sa.Column("stored_seq", sa.BigInteger(), nullable=True),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.Column("touched_at", INSTANT, nullable=False),
        sa.Column("stored_at", INSTANT, nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_trials"),
    )
    op.create_index(
        "ix_trials_user_uuid_created_at_id", "trials", ["user_uuid", "created_at", "id"]
    )


def create_clips() -> None:
    op.create_table(
        "clips",
        sa.Column("trial_id", sa.Uuid(), nullable=False),
        sa.Column("ordinal", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("action", sa.String(200), nullable=True),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("flaw", sa.String(32), nullable=True),
        sa.ForeignKeyConstraint(
            ["trial_id"], ["trials.id"], name="fk_clips_trial_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("trial_id", "ordinal", name="pk_clips"),
    )
    op.create_table(
        "chunks",
        sa.Column("trial_id", sa.Uuid(), nullable=False),
        sa.Column("clip", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("ordinal", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column("payload", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["trial_id", "clip"],
            ["clips.trial_id", "clips.ordinal"],
            name="fk_chunks_trial_id_clip",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("trial_id", "clip", "ordinal", name="pk_chunks"),
    )


def create_jobs() -> None:
    op.create_table(
        "jobs",
        sa.Column("id", sa.Uuid(), nullable=False),
        *owner("jobs"),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("reason", sa.String(32), nullable=False),
        sa.Column("explicit", sa.Boolean(), nullable=False),
        sa.Column("trials", JSON, nullable=True),
        sa.Column("requested_by", sa.Uuid(), nullable=True),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=False),
        sa.Column("lease_owner", sa.String(128), nullable=True),
        sa.Column("lease_until", INSTANT, nullable=True),
        sa.Column("cancelling", sa.Boolean(), nullable=False),
        sa.Column("progress", JSON, nullable=True),
        sa.Column("message", sa.Text(), nullable=True),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.Column("started_at", INSTANT, nullable=True),
        sa.Column("finished_at", INSTANT, nullable=True),
        sa.Column("version", sa.Integer(), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_jobs"),
    )
    create_partial_index("uq_jobs_queued", "jobs", ["user_uuid", "explicit"], "state = 'queued'")
    create_partial_index("uq_jobs_running", "jobs", ["user_uuid"], "state = 'running'")
    op.create_index("ix_jobs_created_at_id", "jobs", ["created_at", "id"])
    op.create_index("ix_jobs_user_uuid_created_at_id", "jobs", ["user_uuid", "created_at", "id"])
    op.create_index("ix_jobs_state_lease_until", "jobs", ["state", "lease_until"])


def create_versions() -> None:
    op.create_table(
        "weights",
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("size", sa.Integer(), nullable=False),
        sa.Column("blob", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.PrimaryKeyConstraint("sha256", name="pk_weights"),
    )
    op.create_table(
        "versions",
        sa.Column("id", sa.Uuid(), nullable=False),
        *owner("versions"),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=False),
        sa.Column("base_sha256", sa.String(64), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("size", sa.Integer(), nullable=False),
        sa.Column("weights_sha256", sa.String(64), nullable=True),
        sa.Column("trained_on", JSON, nullable=False),
        sa.Column("metrics", JSON, nullable=False),
        sa.Column("job_id", sa.Uuid(), nullable=True),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.Column("activated_at", INSTANT, nullable=True),
        sa.CheckConstraint("number >= 1", name=op.f("ck_versions_number")),
        sa.ForeignKeyConstraint(
            ["weights_sha256"], ["weights.sha256"], name="fk_versions_weights_sha256"
        ),
        sa.ForeignKeyConstraint(
            ["job_id"], ["jobs.id"], name="fk_versions_job_id", ondelete="SET NULL"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_versions"),
    )
    create_partial_index("uq_versions_active", "versions", ["user_uuid"], "state = 'active'")
    op.create_index(
        "ix_versions_user_uuid_number", "versions", ["user_uuid", "number"], unique=True
    )
    op.create_index(
        "ix_versions_user_uuid_created_at_id", "versions", ["user_uuid", "created_at", "id"]
    )
    op.create_index("ix_versions_weights_sha256", "versions", ["weights_sha256"])
    op.create_table(
        "activations",
        sa.Column("id", COUNTED, autoincrement=True, nullable=False),
        *owner("activations"),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("actor", sa.Uuid(), nullable=True),
        sa.Column("at", INSTANT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_activations"),
    )
    op.create_index("ix_activations_user_uuid", "activations", ["user_uuid"])


def create_idempotency() -> None:
    op.create_table(
        "idempotency",
        sa.Column("key_id", sa.Uuid(), nullable=False),
        *owner("idempotency"),
        sa.Column("route", sa.String(64), nullable=False),
        sa.Column("token", sa.String(200), nullable=False),
        sa.Column("body_sha256", sa.String(64), nullable=False),
        sa.Column("status", sa.Integer(), nullable=False),
        sa.Column("answer", sa.LargeBinary(), nullable=False),
        sa.Column("expires_at", INSTANT, nullable=False),
        sa.ForeignKeyConstraint(
            ["key_id"], ["api_keys.id"], name="fk_idempotency_key_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("key_id", "user_uuid", "route", "token", name="pk_idempotency"),
    )
    op.create_index("ix_idempotency_expires_at", "idempotency", ["expires_at"])
    op.create_index("ix_idempotency_user_uuid", "idempotency", ["user_uuid"])


def downgrade() -> None:
    for table in (
        "idempotency",
        "activations",
        "versions",
        "weights",
        "jobs",
        "chunks",
        "clips",
        "trials",
    ):
        op.drop_table(table)
    with op.batch_alter_table("users") as users:
        for column in ("served_at", "last_version", "auto_promote"):
            users.drop_column(column)
