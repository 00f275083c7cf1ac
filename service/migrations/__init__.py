"""Alembic's migrations of the store; run at every start by `service.store.migrating.migrate`."""
