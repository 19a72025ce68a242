"""How alembic reaches the database: over the gateway's connection, or, by hand, the one of ``ROBOSAC_DATABASE_URL``."""

from __future__ import annotations

import asyncio

from alembic import context
from sqlalchemy import Connection, make_url

from robosac.extras import MissingExtra
from service.keeping.database import connect
from service.keeping.migrations import lock
from service.keeping.tables import metadata
from service.settings import SettingsError, settings_of_environment


def _run(connection: Connection) -> None:
    context.configure(connection=connection, target_metadata=metadata)
    context.run_migrations()


def _run_locked(connection: Connection) -> None:
    lock(connection)
    _run(connection)


async def _by_hand() -> None:
    try:
        url = settings_of_environment().database_url
        if "database_url" not in settings_of_environment().model_fields_set:
            raise SystemExit("Error: ROBOSAC_DATABASE_URL has to name the database: it would be a new file here")
        database = connect(url)
    except (MissingExtra, SettingsError) as wrong:
        raise SystemExit(f"Error: {wrong}") from wrong
    try:
        await database.prepare(_run_locked)
    finally:
        await database.close()
    print(f"{make_url(url).render_as_string()}: done")


if context.is_offline_mode():
    raise SystemExit("the steps need the database; run alembic without --sql")
given: Connection | None = context.config.attributes.get("connection")
if given is None:
    asyncio.run(_by_hand())
else:
    _run(given)
