"""Run by Alembic: migrate the connection that `service.store.migrating.migrate` hands over."""

from __future__ import annotations

from alembic import context

from sprung.service.store.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata, render_as_batch=True)
with context.begin_transaction():
    context.run_migrations()
