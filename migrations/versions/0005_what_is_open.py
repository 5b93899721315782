"""Indexes for what is asked again and again: recordings without a stream, jobs that just ended."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index(
        "ix_trials_recording",
        "trials",
        ["touched_at"],
        sqlite_where=sa.text("state = 'recording'"),
        postgresql_where=sa.text("state = 'recording'"),
    )
    op.create_index("ix_jobs_user_uuid_finished_at", "jobs", ["user_uuid", "finished_at"])


def downgrade() -> None:
    op.drop_index("ix_jobs_user_uuid_finished_at", "jobs")
    op.drop_index("ix_trials_recording", "trials")
