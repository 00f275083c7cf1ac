"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

System = Annotated[
    Path | None, typer.Option("--system", metavar="FILE", help="System file; default: the Manchester vehicle.")
]
Dbc = Annotated[
    Path | None,
    typer.Option(
        "--dbc", metavar="FILE", help="CAN database; default: the bundled one, where it has the system's signals."
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", metavar="FOLDER", help="Trained estimator; default: the bundled one."),
]
StoreUrl = Annotated[
    str | None,
    typer.Option("--store", metavar="URL", help="SQLAlchemy URL or SQLite file of the store; also SPRUNG_STORE."),
]
Json = Annotated[bool, typer.Option("--json", help="JSON lines on stdout, for machines.")]
