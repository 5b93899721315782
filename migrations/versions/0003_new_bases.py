"""New bases: which one a job is to fit on, and which one a user was last fitted again for."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("users", sa.Column("refitted_for", sa.String(64), nullable=True))
    op.add_column("jobs", sa.Column("base_sha256", sa.String(64), nullable=True))


def downgrade() -> None:
    op.drop_column("jobs", "base_sha256")
    op.drop_column("users", "refitted_for")
