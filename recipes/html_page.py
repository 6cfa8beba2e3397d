"""Pieces of an HTML page that needs no other file: tables, pictures, remarks."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from judgement import show
from matplotlib.figure import Figure

STYLE = """
:root { --ink: #1d2530; --faint: #6b7685; --line: #dde2e8; --good: #1a7f4b; --bad: #b3261e; --card: #f6f8fa; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); padding-bottom: .2rem; }
table { border-collapse: collapse; margin: .8rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; } th { font-weight: 600; }
img { max-width: 100%; height: auto; } figure { margin: 1rem 0; } figcaption, .note { color: var(--faint); }
.pass { color: var(--good); font-weight: 600; } .fail { color: var(--bad); font-weight: 600; }
.headline { background: var(--card); padding: .8rem 1rem; border-radius: 6px; }
.scroll { overflow-x: auto; } pre { background: var(--card); padding: 1rem; overflow-x: auto; font-size: 13px; }
"""


class Markup(str):
    """Text that is HTML already; everything else in a table is escaped."""


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """An HTML table."""

    def line(tag: str, cells: Sequence[Any]) -> str:
        inner = (cell if isinstance(cell, Markup) else escape(str(cell)) for cell in cells)
        return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in inner) + "</tr>"

    body = "\n".join(line("td", row) for row in rows)
    return f'<div class="scroll"><table>{line("th", header)}\n{body}</table></div>'


def image(png: bytes, caption: str) -> str:
    """A picture inside the page."""
    text = escape(caption)
    code = base64.b64encode(png).decode()
    return f'<figure><img alt="{text}" src="data:image/png;base64,{code}"><figcaption>{text}</figcaption></figure>'


def drawn(figure: Figure, caption: str) -> str:
    """A matplotlib figure inside the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return image(buffer.getvalue(), caption)


def note(text: str) -> str:
    """A remark on what is missing."""
    return f'<p class="note">{escape(text)}</p>'


def interval(value: Mapping[str, Any] | None) -> str:
    """An estimate with its interval."""
    return show(None if value is None else [value["estimate"], value["low"], value["high"]])


def picture(path: Path, caption: str) -> str:
    """A PNG of the run inside the page."""
    return image(path.read_bytes(), caption) if path.is_file() else note(f"no picture {path.name}")


def document(title: str, parts: Iterable[str]) -> str:
    """The whole page."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    body = "\n".join(parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n'
