"""Which weights and calibration a session has, to tell others of the same name from them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add them; of older sessions they are not known."""
    for name in ("weights_digest", "calibration_digest"):
        op.add_column("sessions", sa.Column(name, sa.Text))


def downgrade() -> None:
    """Drop them."""
    for name in ("weights_digest", "calibration_digest"):
        op.drop_column("sessions", name)
