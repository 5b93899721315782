"""What bodies were seen live: one voice where trials show different people."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("users", sa.Column("lived_bones", sa.JSON(), nullable=True))
    op.add_column(
        "users", sa.Column("lived_s", sa.Double(), server_default=sa.text("0"), nullable=False)
    )


def downgrade() -> None:
    op.drop_column("users", "lived_s")
    op.drop_column("users", "lived_bones")
