"""`sprung retention`, `backup`, `restore` and `token ...`: stored data, and access to the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sprung.service.cli.help_text import PlainTyper
from sprung.service.cli.options import Json, StoreUrl

token = PlainTyper(help="Access tokens: who may ask the service, and what for.", no_args_is_help=True)
DataDir = Annotated[Path | None, typer.Option("--data-dir", metavar="FOLDER", help="As of sprung serve.")]


def retention(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what would be deleted.")] = False,
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Delete now what is too old to be kept.

    As the settings SPRUNG_RETENTION_... have it; the service does so every hour.
    """
    from sprung.service.cli.retention import run

    return run(dry_run, data_dir, store)


def backup(
    target: Annotated[Path, typer.Argument(help="Back-up to write, as in sprung-2026-09-21.tar.", metavar="FILE")],
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Back up store, uploads and reports into one file.

    The service may run meanwhile.
    """
    from sprung.service.cli.backup import run

    return run(target, data_dir, store)


def restore(
    source: Annotated[Path, typer.Argument(help="Back-up that `sprung backup` wrote.", metavar="FILE")],
    keep_tokens: Annotated[
        bool, typer.Option("--keep-tokens", help="Leave its access tokens good, also those that were revoked since.")
    ] = False,
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Put a back-up into a data folder that has no store yet.

    Its access tokens are revoked, since nothing in it says which of them were revoked later.
    """
    from sprung.service.cli.backup import restore as run

    return run(source, keep_tokens, data_dir, store)


@token.command("create")
def token_create(
    name: Annotated[str, typer.Argument(help="Who or what it is for.")],
    scope: Annotated[str, typer.Option("--scope", help="Of read, ingest, operate, admin, with commas.")] = "read",
    fleet: Annotated[
        str | None, typer.Option("--fleet", help="Only vehicles whose ids begin so; default: all vehicles.")
    ] = None,
    days: Annotated[float, typer.Option("--days", min=0, help="Until it ends; 0: never.")] = 365.0,
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Make a token and print it."""
    from sprung.service.cli.token import create

    return create(name, scope, fleet, days, data_dir, store)


@token.command("list")
def token_list(json_lines: Json = False, data_dir: DataDir = None, store: StoreUrl = None) -> int:
    """List the tokens, without their secrets."""
    from sprung.service.cli.token import show

    return show(json_lines, data_dir, store)


@token.command("rotate")
def token_rotate(
    token_id: Annotated[str, typer.Argument(help="As `sprung token list` shows it.", metavar="ID")],
    hours: Annotated[float, typer.Option("--hours", min=0, help="For which the old one is still good.")] = 24.0,
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Make a token like an old one, and let that end."""
    from sprung.service.cli.token import rotate

    return rotate(token_id, hours, data_dir, store)


@token.command("revoke")
def token_revoke(
    token_id: Annotated[str | None, typer.Argument(help="As `sprung token list` shows it.", metavar="ID")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every token, as after a database was restored.")] = False,
    data_dir: DataDir = None,
    store: StoreUrl = None,
) -> int:
    """Make a token worthless, or all of them."""
    from sprung.service.cli.token import revoke

    return revoke(token_id, every, data_dir, store)
