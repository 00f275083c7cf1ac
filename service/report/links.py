"""Links of a kept page back to the service that shows it; a page on a disk has none."""

from __future__ import annotations

from collections.abc import Mapping

from markupsafe import escape

BACK = "<!-- back -->"  # a service that shows the page puts links to the fleet and the vehicle here


def with_links(page: str, links: Mapping[str, str]) -> str:
    """The page with links back, as {address: text}; as it is where it was made by an earlier version."""
    shown = " · ".join(f'<a href="{escape(address)}">{escape(text)}</a>' for address, text in links.items())
    return page.replace(BACK, shown, 1)
