"""Users, keys, stream sessions and the audit log."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

INSTANT = sa.DateTime(timezone=True)


def upgrade() -> None:
    create_users()
    create_api_keys()
    create_stream_sessions()
    create_audit()


def create_users() -> None:
    op.create_table(
        "users",
        sa.Column("uuid", sa.Uuid(), nullable=False),
        sa.Column("id", sa.String(64), nullable=False),
        sa.Column("skeleton", sa.String(64), nullable=False),
        sa.Column("up", sa.String(2), nullable=False),
        sa.Column("root_relative", sa.Boolean(), nullable=False),
        sa.Column("display_name", sa.String(200), nullable=True),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.CheckConstraint("up IN ('y', '-y', 'z')", name=op.f("ck_users_up")),
        sa.PrimaryKeyConstraint("uuid", name="pk_users"),
        sa.UniqueConstraint("id", name="uq_users_id"),
    )
    op.create_index("ix_users_created_at_uuid", "users", ["created_at", "uuid"])


def create_api_keys() -> None:
    op.create_table(
        "api_keys",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("sha256", sa.LargeBinary(32), nullable=False),
        sa.Column("name", sa.String(200), nullable=True),
        sa.Column("scopes", sa.String(64), nullable=False),
        sa.Column("user_uuid", sa.Uuid(), nullable=True),
        sa.Column("created_at", INSTANT, nullable=False),
        sa.Column("revoked_at", INSTANT, nullable=True),
        sa.Column("last_used_at", INSTANT, nullable=True),
        sa.ForeignKeyConstraint(
            ["user_uuid"], ["users.uuid"], name="fk_api_keys_user_uuid", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_api_keys"),
    )
    op.create_index("ix_api_keys_created_at_id", "api_keys", ["created_at", "id"])
    op.create_index("ix_api_keys_user_uuid", "api_keys", ["user_uuid"])


def create_stream_sessions() -> None:
    op.create_table(
        "stream_sessions",
        sa.Column("user_uuid", sa.Uuid(), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("epoch", sa.BigInteger(), nullable=False),
        sa.Column("key_id", sa.Uuid(), nullable=False),
        sa.Column("opened_at", INSTANT, nullable=False),
        sa.CheckConstraint("epoch >= 1", name=op.f("ck_stream_sessions_epoch")),
        sa.ForeignKeyConstraint(
            ["user_uuid"], ["users.uuid"], name="fk_stream_sessions_user_uuid", ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["key_id"], ["api_keys.id"], name="fk_stream_sessions_key_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("user_uuid", "name", name="pk_stream_sessions"),
    )
    op.create_index("ix_stream_sessions_key_id", "stream_sessions", ["key_id"])


def create_audit() -> None:
    op.create_table(
        "audit",
        sa.Column(
            "id",
            sa.BigInteger().with_variant(sa.Integer(), "sqlite"),
            autoincrement=True,
            nullable=False,
        ),
        sa.Column("at", INSTANT, nullable=False),
        sa.Column("action", sa.String(32), nullable=False),
        sa.Column("actor", sa.Uuid(), nullable=True),
        sa.Column("key_id", sa.Uuid(), nullable=True),
        sa.Column("user_uuid", sa.Uuid(), nullable=True),
        sa.Column("subject", sa.String(64), nullable=True),
        sa.ForeignKeyConstraint(
            ["user_uuid"], ["users.uuid"], name="fk_audit_user_uuid", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_audit"),
    )
    op.create_index("ix_audit_user_uuid", "audit", ["user_uuid"])


def downgrade() -> None:
    op.drop_table("audit")
    op.drop_table("stream_sessions")
    op.drop_table("api_keys")
    op.drop_table("users")
