"""What the reports share: templates of this package, figures made part of a page, numbers."""

from __future__ import annotations

import importlib.resources
import re
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup


def page(template: str, **content: Any) -> str:
    """Return a page from a template of this package, everything in it escaped."""
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(_template),
    )
    environment.filters |= {'fixed': _fixed, 'signed': _signed}
    return environment.get_template(template).render(**content)


def _template(name: str) -> str:
    return importlib.resources.files(__package__).joinpath(name).read_text(encoding='utf-8')


def inlined(name: str, svg: str) -> Markup:
    """Make a figure part of the page: its colours, its font, its width, identifiers of its own."""
    from remaster_ros.reports.figures import GRID, INK, PAPER

    svg = svg[svg.index('<svg') :]
    for color, ours in ((INK, 'var(--ink)'), (GRID, 'var(--line)'), (PAPER, 'none')):
        svg = svg.replace(color, ours)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", 'var(--font)', svg)
    svg = re.sub(r'(<svg [^>]*?) width="[^"]*"', r'\1', svg, count=1)
    svg = re.sub(r'(<svg [^>]*?) height="[^"]*"', r'\1', svg, count=1)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', svg)
    return Markup(re.sub(r'(url\(#|href="#)', rf'\1{name}-', svg))


def _fixed(number: float | None, digits: int) -> str:
    return '–' if number is None else f'{number:.{digits}f}'.replace('-', '−')


def _signed(number: float, digits: int) -> str:
    return f'{number:+.{digits}f}'.replace('-', '−')
